// The live page of a bench: what comes by the websocket goes to plots and panels.

import { Attitude } from "./attitude.js";
import { Choice } from "./choice.js";
import * as controls from "./controls.js";
import { EventList } from "./events.js";
import { Feed } from "./feed.js";
import { clock, count, say, seconds } from "./format.js";
import * as gestures from "./gestures.js";
import { History, MARK } from "./history.js";
import { Overview } from "./overview.js";
import { offerFaults, offerSays, showStatus } from "./panels.js";
import { Plot } from "./plot.js";
import { Samples } from "./samples.js";
import { Timeline } from "./timeline.js";

const HEAD = 16; // bytes: run u32, sequence u32, time f64
const QUIET_MS = 2000; // without a sample the bench is waited for
const REST = 2; // times as long as drawing took, so that a slow machine keeps up
const SLOWEST_MS = 1000; // between two pictures

const byId = (id) => document.getElementById(id);

/** What the page has seen, for tests and for the curious. */
const bench = { run: null, hellos: 0, received: 0, shown: 0, repeated: 0, missed: 0, dropped: 0, reconnects: 0, errors: [], state: "waiting", plots: [], time: NaN, frames: 0, drawn_ms: 0 };
window.bench = bench;
addEventListener("error", (event) => bench.errors.push(String(event.message)));
addEventListener("unhandledrejection", (event) => bench.errors.push(String(event.reason)));

let samples = new Samples(0);
let views = []; // all plots and attitudes
let shown = []; // of them
let palette;
let signals = "";
let last = -1; // number of the newest sample
let history = 0; // samples that are still to come of what was before
let fresh = -Infinity; // when the last new one came
let pending = 0; // samples that are not drawn yet
let dirty = false; // something is to be drawn at once
let pointed = false; // the cursor is elsewhere
let cursor = null; // time at it
let due = 0; // when the next picture of new samples is
let rested = 0;
let status = null; // the latest status of the bench
let chosen = null; // the event that was selected

const redraw = () => (dirty = true);
const timeline = new Timeline(redraw);
const choice = new Choice(byId("choices"), arrange);
const overview = new Overview(byId("overview"), timeline);
const events = new EventList({
  go(event) {
    chosen = event.id;
    events.choose(chosen);
    timeline.go(event.time_s);
  },
  acknowledge: (alarms) => press({ do: "acknowledge", alarms }),
  changed() {
    redraw();
    entitle();
  },
});

// ------------------------------------------------------------------------------------- colours

function colours() {
  const style = getComputedStyle(document.documentElement);
  const get = (name) => style.getPropertyValue(name).trim();
  const lines = ["--x", "--y", "--z", "--w"].map(get);
  const levels = { info: get("--dim"), warning: get("--warning"), alarm: get("--alarm") };
  const craft = { craft: get("--craft"), ghost: get("--ghost"), frame: get("--dim") };
  return { lines, bands: lines.map((c) => `${c}1c`), limit: get("--alarm"), text: get("--dim"), grid: get("--grid"), fault: get("--warning"), levels, ...craft };
}

function paint() {
  palette = colours();
  for (const view of views) view.paint(palette);
  redraw();
}

/** Show the plots that are chosen. */
function arrange() {
  shown = views.filter((view) => choice.shows(view.title));
  byId("plots").replaceChildren(...shown.map((view) => view.figure));
  say(byId("choice-tally"), shown.length < views.length ? ` ${shown.length} of ${views.length}` : "");
  refresh();
  redraw();
}

// -------------------------------------------------------------------------------------- what comes

function hello(message) {
  bench.hellos++;
  if (!message.bench && bench.run !== null) return; // a restarted server; wait for the bench
  const anew = message.run !== bench.run || JSON.stringify(message.signals) !== signals;
  if (anew && message.bench) {
    bench.run = message.run;
    signals = JSON.stringify(message.signals);
    begin(message);
  }
  events.show(message.events);
  offerFaults(message.faults);
  offerSays(message.says);
  told({ kind: "status", status: message.status });
  history = message.history;
  say(byId("run"), message.bench ? String(message.run) : "–");
  if (message.title) say(byId("title"), message.title);
  refresh();
}

/** A run that this page has not seen: nothing of the one before stays. */
function begin(message) {
  for (const view of views) view.destroy();
  samples = new Samples(message.signals.length);
  last = -1;
  fresh = -Infinity;
  pending = 0;
  cursor = chosen = null;
  timeline.now = 0;
  timeline.follow();
  Object.assign(bench, { received: 0, shown: 0, missed: 0, repeated: 0, time: NaN });
  const titles = [...new Set(message.signals.map((s) => s.plot))];
  const indexed = message.signals.map((s, index) => ({ ...s, index }));
  views = titles.map((title) => {
    const own = indexed.filter((s) => s.plot === title);
    return new (own[0].role === "attitude" ? Attitude : Plot)(title, own);
  });
  bench.plots = views.filter((view) => view instanceof Plot);
  bench.attitudes = views.filter((view) => view instanceof Attitude);
  choice.offer(message.signals);
  arrange();
  say(byId("sequence"), "–");
  say(byId("time"), "–");
  paint();
}

/** What was before the samples that follow; a page that has seen all of it keeps its own. */
function remembered(buffer) {
  const past = History.read(buffer);
  if (samples.last >= past.last[past.buckets - 1]) return;
  samples = new Samples(samples.values.length, past);
  last = -1;
  redraw();
}

function sampled(view) {
  if (view.getUint32(4, true) === MARK && view.getUint32(0, true) === bench.run >>> 0) return remembered(view.buffer);
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
      if (JSON.stringify(message.status?.fault_spans) !== JSON.stringify(status?.fault_spans)) redraw();
      status = message.status;
      showStatus(status);
      return refresh();
    case "event":
      return events.add(message);
    case "acknowledged":
      return events.acknowledged(message.alarms);
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
      return events.add({ id: "ended", level: "info", time_s: samples.last, text: "the bench has ended" });
    default:
      bench.errors.push(`unknown message ${message.kind}`);
      return undefined;
  }
}

// ------------------------------------------------------------------------------------------ state

function refresh() {
  const quiet = performance.now() - fresh > QUIET_MS;
  const preparing = status?.state === "preparing";
  const open = preparing ? "preparing" : quiet ? "waiting" : "live";
  const state = !feed.open && (feed.opened || feed.failed) ? "lost" : feed.open ? open : "waiting";
  if (state !== bench.state) {
    bench.state = state;
    document.body.dataset.state = state;
    say(byId("state"), state);
    entitle();
  }
  notice();
  controls.allow(feed.open, status?.state);
}

/** Alarms that wait and the state, so that they are seen while another page is in front. */
function entitle() {
  const waiting = events.waiting.length;
  const state = bench.state === "live" ? "" : `(${bench.state}) `;
  document.title = `${waiting ? `(${waiting}) ` : ""}${state}${byId("title").textContent}`;
}

/** Why there is nothing to see, where there is nothing. */
function notice() {
  const nothing = !Number.isFinite(samples.last);
  let text = "";
  if (bench.run === null) text = "Waiting for a bench.";
  else if (!shown.length) text = "All plots are hidden. Choose some under Plots.";
  else if (nothing && status?.state === "preparing") text = `Preparing. ${status.doing ?? ""}`;
  else if (nothing && status?.state === "paused") text = "The run has not begun. Press Start.";
  say(byId("notice"), text);
  byId("notice").hidden = !text;
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
  const began = performance.now();
  if (began < rested || !views.length) return;
  if (dirty || (pending && began >= due)) picture(began);
  else if (pointed) for (const view of shown) view.read(context());
  else return;
  pointed = false;
  bench.frames++;
  queueMicrotask(() => {
    // after those in which the plots are drawn
    bench.drawn_ms = performance.now() - began;
    rested = performance.now() + REST * bench.drawn_ms;
  });
}

const spans = () => status?.fault_spans ?? [];

function context() {
  const first = shown.find((view) => view instanceof Plot);
  return { samples, span: timeline.span, hidden: choice.signals, spans: spans(), events: events.all, chosen, cursor, first };
}

function picture(began) {
  dirty = false;
  timeline.now = bench.time = Number.isFinite(samples.last) ? samples.last : 0;
  const [from, to] = timeline.span;
  const all = { ...context(), slice: samples.slice(from, to) };
  for (const view of shown) {
    view.fitToPage();
    view.show(all);
  }
  overview.draw(all, palette);
  bench.shown += pending;
  pending = 0;
  if (last >= 0) say(byId("sequence"), count(last));
  if (!Number.isNaN(samples.last)) say(byId("time"), seconds(timeline.now));
  const { live } = timeline;
  document.body.dataset.view = live ? "live" : "held";
  byId("follow").setAttribute("aria-pressed", String(live));
  const step = (to - from) / 100;
  say(byId("window"), live ? "" : `${clock(from, step)} to ${clock(to, step)}, ${seconds(timeline.now - to)} ago`);
  due = began + (live ? Math.min(SLOWEST_MS, to - from) : SLOWEST_MS); // a pixel has some samples
}

// ------------------------------------------------------------------------------------ who presses

const feed = new Feed({ told, sampled, changed });
const press = controls.wire((command) => feed.send(command));
gestures.wire(timeline, byId("plots"), byId("timebar"), () => events.acknowledgeAll());
byId("span").addEventListener("change", (event) => timeline.show(Number(event.target.value)));
document.addEventListener("click", ({ target }) => {
  const there = target.closest("[data-go]");
  if (there) timeline.go(Number(there.dataset.go));
  const signal = target.closest("[data-signal]");
  if (signal) choice.toggleSignal(signal.dataset.signal);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
new ResizeObserver(redraw).observe(byId("plots"));
byId("plots").addEventListener("rescaled", redraw);
for (const type of ["pointermove", "pointerleave"])
  byId("plots").addEventListener(type, (event) => {
    const over = type === "pointermove" && event.target.closest?.(".u-over");
    const [from, to] = timeline.span;
    const box = over && over.getBoundingClientRect();
    cursor = over ? from + ((event.clientX - box.left) / box.width) * (to - from) : null;
    pointed = true;
  });
setInterval(refresh, 250);
refresh();
requestAnimationFrame(draw);
