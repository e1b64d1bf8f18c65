// One plot: values, their bands and limits, and what they are now.

import { clock, decimalsFor, element, number, say, tick, TIME_STEPS } from "./format.js";
import { drawBands, drawEvents } from "./marks.js";
import { Scale } from "./scale.js";

/* global uPlot */

const BAND = 3; // sigmas
const AXIS_WIDTH = 46;
const FEW = 0.4; // of the samples: a signal that comes more seldom gets points

/** What remains of names without what all of them begin with. */
function shortNames(names) {
  if (names.length < 2) return names.map(() => "");
  const words = names.map((name) => name.split(/[\s_.]+/));
  let same = 0;
  while (words.every((w) => w.length > same + 1 && w[same] === words[0][same])) same++;
  return words.map((w) => w.slice(same).join(" "));
}

/** The value at an index, or the one before it that still goes on. */
function heldAt(column, at) {
  let k = at;
  while (k > 0 && column[k] === undefined) k--;
  return column[k];
}

export class Plot {
  /** Signals have their `index` in a sample. */
  constructor(title, signals) {
    this.title = title;
    this.unit = signals[0].unit === "1" ? "no unit" : signals[0].unit;
    this.values = signals.filter((s) => s.role === "value");
    this.sigmas = signals.filter((s) => s.role === "sigma");
    this.limits = signals.filter((s) => s.role === "limit");
    this.scale = new Scale();
    this.few = [];
    this.#build();
  }

  #build() {
    this.note = element("span", "note-in-plot");
    this.readouts = this.values.map((s, k) => {
      const value = element("b", "", "–");
      const names = shortNames(this.values.map((v) => v.name));
      const line = element("button", `readout colour-${k % 4}`, element("i"), names[k], value);
      Object.assign(line, { type: "button", tabIndex: -1, title: `${s.name}: show or hide` });
      line.dataset.signal = s.name;
      return { line, value };
    });
    this.canvas = element("div", "canvas", this.note);
    this.figure = element(
      "figure",
      "plot",
      element(
        "figcaption",
        "",
        element("strong", "", this.title),
        element("span", this.values.length > 3 ? "readouts many" : "readouts", ...this.readouts.map((r) => r.line)),
      ),
      this.canvas,
    );
    this.figure.setAttribute("aria-label", `${this.title} [${this.unit}]; Enter: whole range or fitted to bands and limits`);
    this.figure.tabIndex = 0;
    this.figure.addEventListener("dblclick", () => this.#toggle());
    this.figure.addEventListener("keydown", (event) => event.key === "Enter" && this.#toggle());
  }

  #toggle() {
    this.scale.whole = !this.scale.whole;
    this.scale.top = 0;
    this.figure.dispatchEvent(new Event("rescaled", { bubbles: true }));
  }

  /** Draw with these colours; called again when they change. */
  paint(colours) {
    this.colours = colours;
    const data = this.chart?.data;
    this.chart?.destroy();
    this.chart = new uPlot(this.#options(colours), data ?? this.#nothing(), this.canvas);
  }

  #nothing() {
    return [[], ...Array.from({ length: this.values.length + 2 * this.sigmas.length + this.limits.length }, () => [])];
  }

  #options(colours) {
    const line = (stroke, more) => ({ stroke, width: 1.4, points: { show: false }, spanGaps: false, ...more });
    const series = [{}];
    const bands = [];
    this.values.forEach((_, k) =>
      series.push(line(colours.lines[k % 4], { points: { show: () => this.few[k], size: 4, fill: colours.lines[k % 4] } })),
    );
    this.sigmas.forEach((s) => {
      const k = this.values.findIndex((v) => v.name === s.of) % 4;
      const edge = { width: 0.7, alpha: 0.6 };
      bands.push({ series: [series.length, series.length + 1], fill: colours.bands[k] });
      series.push(line(colours.lines[k], edge), line(colours.lines[k], edge));
    });
    this.limits.forEach(() => series.push(line(colours.limit, { width: 1.2, dash: [7, 4] })));
    const axis = { stroke: colours.text, grid: { stroke: colours.grid, width: 1 }, ticks: { stroke: colours.grid, size: 4 }, font: "11px system-ui, sans-serif" };
    const [width, height] = this.#size();
    return {
      width,
      height,
      legend: { show: false },
      padding: [8, 16, 0, 0],
      cursor: { sync: { key: "time" }, drag: { x: false, y: false }, points: { size: (_, k) => (k <= this.values.length ? 5 : 0) }, y: false },
      scales: { x: { time: false, range: () => this.span ?? [0, 1] }, y: { range: () => this.range ?? [0, 1] } },
      axes: [
        { ...axis, size: 22, gap: 2, space: 70, incrs: TIME_STEPS, values: (_, ticks, __, ___, step) => ticks.map((t) => clock(t, step)) },
        { ...axis, size: AXIS_WIDTH, gap: 3, space: 32, values: (_, ticks) => ticks.map((t) => tick(t, this.range?.[1] ?? 1)) },
      ],
      series,
      bands,
      hooks: { drawClear: [(chart) => this.#under(chart)], draw: [(chart) => this.#mark(chart)] },
    };
  }

  #size() {
    return [Math.max(120, this.canvas.clientWidth), Math.max(80, this.canvas.clientHeight)];
  }

  fitToPage() {
    const [width, height] = this.#size();
    if (this.chart && (width !== this.chart.width || height !== this.chart.height)) this.chart.setSize({ width, height });
  }

  /** Show a slice of the samples; signals whose names are hidden take no part. */
  show(context) {
    const { slice, span, hidden } = context;
    this.context = context;
    const time = Array.from(slice.time);
    const nothing = () => ({ out: new Array(time.length), found: time.length, last: NaN });
    const read = (s, factor) => (hidden.has(s.name) || hidden.has(s.of) ? nothing() : slice.column(s.index, factor));
    const values = this.values.map((s) => read(s));
    const sigmas = this.sigmas.map((s) => read(s, BAND));
    const limits = this.limits.map((s) => read(s));
    const uppers = sigmas.map((s) => s.out);
    const lowers = uppers.map((out) => out.map((v) => (typeof v === "number" ? -v : v)));
    this.few = values.map((v) => v.found < FEW * time.length || v.found < 3);
    this.range = this.scale.fit(values.map((v) => v.out), uppers, limits.map((v) => v.out));
    this.span = span;
    this.beyond = {
      sigma: this.values.map((v) => sigmas[this.sigmas.findIndex((s) => s.of === v.name)]?.last),
      limit: limits.length ? Math.max(...limits.map((l) => Math.abs(l.last))) : NaN,
    };
    this.latest = values.map((v) => v.last);
    const pairs = uppers.flatMap((upper, k) => [upper, lowers[k]]);
    this.chart.setData([time, ...values.map((v) => v.out), ...pairs, ...limits.map((v) => v.out)], true);
    this.read();
  }

  destroy() {
    this.chart?.destroy();
  }

  /** What the values are: at the cursor where there is one, else now. */
  read() {
    const decimals = decimalsFor(this.range[1]);
    const left = this.chart.cursor.left;
    const at = left >= 0 ? this.chart.posToIdx(left) : null;
    this.readouts.forEach(({ line, value }, k) => {
      const shown = at === null ? this.latest[k] : heldAt(this.chart.data[k + 1], at);
      say(value, number(shown, decimals));
      const edge = this.beyond.sigma[k] ?? this.beyond.limit;
      line.classList.toggle("off", this.context.hidden.has(this.values[k].name));
      line.classList.toggle("beyond", at === null && Math.abs(shown) > edge);
    });
    const { limit } = this.beyond;
    const notes = [this.unit];
    if (this.sigmas.length) notes.push("band ±3σ");
    if (Number.isFinite(limit)) notes.push(`limit ${Number(limit.toPrecision(3))}`);
    if (this.scale.whole) notes.push("whole range");
    say(this.note, notes.join(" · "));
  }

  /** Behind the lines: when faults were on. */
  #under(chart) {
    const { spans, samples, first } = this.context ?? { spans: [] };
    if (this.span) drawBands(chart, this.span, spans, samples?.last, this.colours, first === this);
  }

  /** Events; triangles at the edge where values are off the scale, rings where they are over the limit. */
  #mark(chart) {
    const { ctx, bbox } = chart;
    if (this.context) drawEvents(chart, this.span, this.context.events, this.context.chosen, this.colours);
    const [least, most] = this.range ?? [0, 1];
    const limit = this.beyond?.limit ?? NaN;
    const size = 5 * devicePixelRatio;
    ctx.save();
    this.values.forEach((_, k) => {
      ctx.fillStyle = this.colours.lines[k % 4];
      ctx.strokeStyle = this.colours.limit;
      ctx.lineWidth = 1.5 * devicePixelRatio;
      const column = chart.data[k + 1];
      let before = -Infinity;
      column.forEach((value, i) => {
        if (typeof value !== "number") return;
        const off = value > most || value < least;
        if (!off && !(Math.abs(value) > limit)) return;
        const x = chart.valToPos(chart.data[0][i], "x", true);
        if (x < bbox.left || (x - before < size && off)) return;
        if (off) {
          before = x;
          const up = value > most;
          const edge = up ? bbox.top : bbox.top + bbox.height;
          const inner = edge + (up ? 1.6 : -1.6) * size;
          ctx.beginPath();
          ctx.moveTo(x, edge);
          ctx.lineTo(x - size, inner);
          ctx.lineTo(x + size, inner);
          ctx.fill();
        } else {
          ctx.beginPath();
          ctx.arc(x, chart.valToPos(value, "y", true), 0.8 * size, 0, 2 * Math.PI);
          ctx.stroke();
        }
      });
    });
    ctx.restore();
  }
}
