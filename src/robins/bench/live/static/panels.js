// Everything next to the plots but the events: clock, links, commands to the parts, faults, counts.

import { clock as timeOf, count, element, number, say, seconds } from "./format.js";

const byId = (id) => document.getElementById(id);
const SILENT_S = 1;
const MOST_PAST = 50; // faults that are over and are listed
const GOOD = /^(ok|up|run|ready|live|alive|done)/i;
const BAD = /^(dead|fail|kill|lost|gone|silent)/i;

/** One number with its name. `mood`: "", "warning" or "alarm". */
function fact(name, text, mood = "") {
  const value = element("dd", mood, text);
  return element("div", "", element("dt", "", name), value);
}

/** Put in place of the old only if something changed. */
function replace(parent, children) {
  const made = element("div", "", ...children).innerHTML;
  if (parent.innerHTML !== made) parent.replaceChildren(...children);
}

function showDeadlines(deadlines = {}, clock) {
  const late = deadlines.lateness_us ?? {};
  const { missed } = deadlines;
  say(byId("clock"), clock ?? "–");
  replace(byId("deadlines"), [
    fact("cycles/s", number(deadlines.cycles_per_s, 1)),
    fact("missed", count(missed), missed > 0 ? "warning" : ""),
    fact("p50 [µs]", count(late.p50)),
    fact("p99 [µs]", count(late.p99)),
    fact("max [µs]", count(late.max)),
  ]);
  showHistogram(deadlines.histogram);
}

/** How often a step was how late: bars by the logarithm of their counts, so that a single one shows. */
function showHistogram(histogram) {
  const place = byId("histogram");
  const counts = histogram?.counts ?? [];
  place.hidden = !counts.length;
  if (!counts.length) return;
  const { edges_us: edges } = histogram;
  const height = (n) => (n > 0 ? Math.log10(1 + n) : 0);
  const most = Math.max(1, ...counts.map(height));
  const range = (k) => (k === 0 ? `below ${edges[0]}` : k === edges.length ? `${edges[k - 1]} or more` : `${edges[k - 1]} to ${edges[k]}`);
  replace(place, counts.map((n, k) => {
    const bar = element("i");
    bar.style.height = `${(100 * height(n)) / most}%`;
    bar.title = `${range(k)} µs: ${count(n)}`;
    return bar;
  }));
  const time = (us) => (us < 1000 ? `${us} µs` : us < 1e6 ? `${us / 1000} ms` : `${us / 1e6} s`);
  Object.assign(place.dataset, { least: time(edges[0]), most: time(edges[edges.length - 1]) });
  place.setAttribute("aria-label", `Lateness of steps: ${counts.map((n, k) => (n ? `${range(k)} µs ${n}` : "")).filter(Boolean).join(", ")}`);
}

function showLinks(links = {}, nodes = {}) {
  const names = [...new Set([...Object.keys(links), ...Object.keys(nodes)])];
  const rows = names.map((name) => {
    const link = links[name] ?? {};
    const state = String(nodes[name] ?? "–");
    const mood = BAD.test(state) ? "alarm" : GOOD.test(state) || state === "–" ? "" : "warning";
    const word = element("td", `word ${mood}`, element("i"), state);
    word.title = state;
    const counted = ["wrong", "lost", "late"].map((key) => element("td", link[key] > 0 ? "warning" : "", count(link[key])));
    const silent = element("td", link.silent_s > SILENT_S ? "alarm" : "", number(link.silent_s, 1));
    const head = element("th", "", name);
    head.scope = "row";
    return element("tr", "", head, word, element("td", "", count(link.frames)), ...counted, silent);
  });
  replace(byId("links").tBodies[0], rows);
}

/** Faults that act; below, those that did, each with a button that goes there. */
function showFaults(faults = [], spans = []) {
  const rows = faults.map((fault) => {
    const given = typeof fault === "string" ? { label: fault } : fault;
    const until = Number.isFinite(given.until_s) ? `until ${seconds(given.until_s)}` : "until cleared";
    const clear = element("button", "small", "Clear");
    clear.type = "button";
    clear.dataset.do = "clear";
    clear.dataset.label = given.label;
    clear.setAttribute("aria-label", `Clear ${given.label}`);
    return element("li", "", element("span", "", String(given.label)), element("small", "", until), clear);
  });
  const past = spans.filter((one) => one.end_s !== null).slice(-MOST_PAST).reverse();
  const over = past.map(({ label, begin_s: begin, end_s: end }) => {
    const step = end - begin < 1 || begin < 60 ? 0.1 : 1;
    const at = element("button", "time", `${timeOf(begin, step)} to ${timeOf(end, step)}`);
    Object.assign(at, { type: "button", title: `show ${label}` });
    at.dataset.go = begin;
    return element("li", "over", element("span", "", label), at);
  });
  replace(byId("faults"), [...rows, ...over]);
  say(byId("fault-tally"), faults.length ? `${faults.length} active` : "none");
  byId("fault-tally").classList.toggle("warning", faults.length > 0);
}

function showCounts(counts = {}) {
  replace(
    byId("counts"),
    Object.entries(counts).map(([name, value]) => {
      const mood = value > 0 && /refused|wrong|lost/.test(name) ? "warning" : "";
      const made = fact(name.replace(/_(frames|measurements)$/, "").replaceAll("_", " "), count(value), mood);
      made.title = name.replaceAll("_", " ");
      return made;
    }),
  );
}

/** The latest status of the bench. */
export function showStatus(status) {
  const given = status ?? {};
  showDeadlines(given.deadlines, given.clock);
  showLinks(given.links, given.nodes);
  showFaults(given.faults, given.fault_spans);
  showCounts(given.counts);
  const state = given.state ?? "–";
  say(byId("bench-state"), state);
  byId("bench-state").classList.toggle("alarm", state === "failed");
  document.body.dataset.bench = state;
}

/** Operator messages, a button each; none, no section. */
export function offerSays(says) {
  const buttons = says.map((label) => {
    const button = element("button", "small", label);
    button.type = "button";
    Object.assign(button.dataset, { do: "say", label });
    return button;
  });
  replace(byId("says"), buttons);
  byId("says").parentElement.hidden = !buttons.length;
}

/** Faults that can be injected. What was chosen stays chosen, so that a server may come and go. */
export function offerFaults(faults) {
  const list = byId("fault");
  const chosen = list.value;
  const options = faults.map(({ label }) => new Option(label, label, false, label === chosen));
  list.replaceChildren(...(options.length ? options : [new Option("no faults prepared", "")]));
  byId("inject").classList.toggle("none", !options.length);
}
