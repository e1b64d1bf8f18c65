// The live page of a bench: what comes by the websocket goes to plots and panels.

import * as controls from "./controls.js";
import { Feed } from "./feed.js";
import { count, say, seconds } from "./format.js";
import { addEvent, clearEvents, offerFaults, showStatus } from "./panels.js";
import { Plot } from "./plot.js";
import { Samples } from "./samples.js";

const HEAD = 16; // bytes: run u32, sequence u32, time f64
const QUIET_MS = 2000; // without a sample the bench is waited for
const REST = 2; // times as long as drawing took, so that a slow machine keeps up

const byId = (id) => document.getElementById(id);

/** What the page has seen, for tests and for the curious. */
const bench = { run: null, hellos: 0, received: 0, shown: 0, repeated: 0, missed: 0, dropped: 0, reconnects: 0, errors: [], state: "waiting", plots: [] };
window.bench = bench;
addEventListener("error", (event) => bench.errors.push(String(event.message)));
addEventListener("unhandledrejection", (event) => bench.errors.push(String(event.reason)));

let samples = new Samples(0);
let plots = [];
let signals = "";
let last = -1; // number of the newest sample
let history = 0; // samples that are still to come of what was before
let fresh = -Infinity; // when the last new one came
let pending = 0; // samples that are not drawn yet
let dirty = false;
let rested = 0;
let benchState;

// ------------------------------------------------------------------------------------- colours

function colours() {
  const style = getComputedStyle(document.documentElement);
  const get = (name) => style.getPropertyValue(name).trim();
  const lines = ["--x", "--y", "--z", "--w"].map(get);
  return { lines, bands: lines.map((c) => `${c}1c`), limit: get("--alarm"), text: get("--dim"), grid: get("--grid") };
}

function paint() {
  const now = colours();
  for (const plot of plots) plot.paint(now);
  dirty = true;
}

// -------------------------------------------------------------------------------------- what comes

function hello(message) {
  bench.hellos++;
  if (!message.bench && bench.run !== null) return; // a server that came anew; the bench is to speak
  const anew = message.run !== bench.run || JSON.stringify(message.signals) !== signals;
  if (anew && message.bench) {
    bench.run = message.run;
    signals = JSON.stringify(message.signals);
    begin(message);
  }
  clearEvents();
  for (const event of message.events) addEvent(event, false);
  offerFaults(message.faults);
  benchState = message.status?.state;
  showStatus(message.status);
  history = message.history;
  say(byId("run"), message.bench ? String(message.run) : "–");
  if (message.title) say(byId("title"), message.title);
  refresh();
}

/** A run that this page has not seen: nothing of the one before stays. */
function begin(message) {
  for (const plot of plots) plot.chart.destroy();
  samples = new Samples(message.signals.length);
  last = -1;
  fresh = -Infinity;
  pending = 0;
  Object.assign(bench, { received: 0, shown: 0, missed: 0, repeated: 0 });
  const titles = [...new Set(message.signals.map((s) => s.plot))];
  const indexed = message.signals.map((s, index) => ({ ...s, index }));
  plots = titles.map((title) => new Plot(title, indexed.filter((s) => s.plot === title)));
  bench.plots = plots;
  byId("plots").replaceChildren(...plots.map((plot) => plot.figure));
  say(byId("sequence"), "–");
  say(byId("time"), "–");
  paint();
}

function sampled(view) {
  const old = history > 0;
  if (old) history--;
  if (view.getUint32(0, true) !== bench.run >>> 0) return;
  const number = view.getUint32(4, true);
  const time = view.getFloat64(8, true);
  if (number <= last || !(time > (samples.length ? samples.last : -Infinity))) {
    bench.repeated++;
    return;
  }
  if (last >= 0) bench.missed += number - last - 1;
  last = number;
  samples.add(time, view, HEAD);
  bench.received++;
  pending++;
  dirty = true;
  if (!old) {
    fresh = performance.now();
    if (bench.state !== "live") refresh();
  }
}

function told(message) {
  switch (message.kind) {
    case "hello":
      return hello(message);
    case "status":
      benchState = message.status.state;
      showStatus(message.status);
      return refresh();
    case "event":
      return addEvent(message);
    case "beat":
      bench.dropped = message.dropped + message.dropped_before;
      say(byId("dropped"), count(bench.dropped));
      byId("dropped").classList.toggle("warning", bench.dropped > 0);
      return undefined;
    case "taken":
      return controls.told(`${message.do}: the bench has it`, true);
    case "refused":
      return controls.told(message.text, false);
    case "ended":
      say(byId("bench-state"), "ended");
      return addEvent({ level: "info", time_s: samples.last, text: "the bench has ended" });
    default:
      bench.errors.push(`unknown message ${message.kind}`);
      return undefined;
  }
}

// ------------------------------------------------------------------------------------------ state

function refresh() {
  const quiet = performance.now() - fresh > QUIET_MS;
  const state = !feed.open && (feed.opened || feed.failed) ? "lost" : !feed.open || quiet ? "waiting" : "live";
  if (state !== bench.state) {
    bench.state = state;
    document.body.dataset.state = state;
    say(byId("state"), state);
    document.title = `${state === "live" ? "" : `(${state}) `}${byId("title").textContent}`;
  }
  controls.allow(feed.open, benchState);
}

function changed(open) {
  if (open) bench.reconnects = feed.opened - 1;
  else feed.failed = true;
  say(byId("reconnects"), String(bench.reconnects));
  refresh();
}

// ---------------------------------------------------------------------------------------- drawing

function draw() {
  requestAnimationFrame(draw);
  if (!dirty || !plots.length || performance.now() < rested) return;
  dirty = false;
  const began = performance.now();
  const length = Number(byId("span").value);
  const now = Number.isFinite(samples.last) ? samples.last : 0;
  const span = [Math.max(0, now - length), Math.max(length, now)];
  const start = Math.max(0, samples.from(span[0]) - 1); // the line comes in from the left
  for (const plot of plots) {
    plot.fitToPage();
    plot.show(samples, start, span);
  }
  bench.shown += pending;
  pending = 0;
  if (last >= 0) {
    say(byId("sequence"), count(last));
    say(byId("time"), seconds(now));
  }
  rested = performance.now() + REST * (performance.now() - began);
}

const feed = new Feed({ told, sampled, changed });
controls.wire((command) => feed.send(command));
byId("span").addEventListener("change", () => (dirty = true));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
new ResizeObserver(() => (dirty = true)).observe(byId("plots"));
for (const type of ["pointermove", "pointerleave", "rescaled"]) byId("plots").addEventListener(type, () => (dirty = true));
setInterval(refresh, 250);
refresh();
requestAnimationFrame(draw);
