// Attitudes in three dimensions, and the angle between them in words.

import { Craft } from "./craft.js";
import { element, number, say } from "./format.js";
import { angleBetween, normalised } from "./quaternion.js";

const ARCSEC = Math.PI / 648000;
const DEGREE = Math.PI / 180;

/** An angle [rad] in fitting units. */
function angle(value) {
  if (!Number.isFinite(value)) return "–";
  return value < 0.1 * DEGREE ? `${number(value / ARCSEC, 1)} arcsec` : `${number(value / DEGREE, 2)}°`;
}

const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);

export class Attitude {
  /** Signals have their `index` in a sample: four for each attitude. */
  constructor(title, signals) {
    this.title = title;
    this.groups = [];
    for (let k = 0; k < signals.length; k += 4) this.groups.push({ of: signals[k].of, indices: signals.slice(k, k + 4).map((s) => s.index) });
    const axes = ["x", "y", "z"].map((name, k) => element("span", `readout colour-${k}`, element("i"), name));
    this.readout = element("b", "", "–");
    const [first, second] = this.groups;
    const apart = second ? [element("span", "readout apart", `${first.of} to ${second.of}`, this.readout)] : [];
    this.note = element("span", "note-in-plot");
    this.surface = element("canvas");
    this.canvas = element("div", "canvas", this.note, this.surface);
    this.figure = element("figure", "plot attitude", element("figcaption", "", element("strong", "", title), element("span", "readouts", ...axes, ...apart)), this.canvas);
    this.figure.setAttribute("aria-label", `${title}: ${this.groups.map((g) => g.of).join(", ")}; body axes against the reference`);
    this.craft = new Craft(this.surface);
    this.surface.addEventListener("webglcontextrestored", () => (this.drawn = ""));
    if (!this.craft.supported) this.surface.replaceWith(element("p", "empty", "This browser has no WebGL, so the attitude is not drawn."));
  }

  paint(colours) {
    const { lines, craft, ghost, frame } = colours;
    this.colours = { axes: lines.map(rgb), craft: rgb(craft), ghost: rgb(ghost), frame: rgb(frame) };
  }

  fitToPage() {} // it does so when it draws

  /** Show the attitudes at the time of the cursor, else at the end of the span. */
  show({ samples, span, cursor }) {
    const time = cursor ?? Math.min(span[1], samples.last);
    this.now = this.groups.map(({ indices }) => normalised(indices.map((k) => samples.valueAt(k, time))));
    const [first, second] = this.now;
    const unknown = this.groups.filter((_, k) => !this.now[k]).map((g) => g.of);
    say(this.readout, first && second ? angle(angleBetween(first, second)) : "–");
    const names = this.groups.map((g, k) => (k ? `ghost: ${g.of}` : `solid: ${g.of}`)).join(" · ");
    say(this.note, unknown.length ? `${names} · not known here: ${unknown.join(", ")}` : names);
    this.#draw();
  }

  /** Only where it would look different: without a graphics card it is dear. */
  #draw() {
    const { clientWidth, clientHeight } = this.surface;
    const looks = JSON.stringify([this.now.map((q) => q?.map((u) => u.toFixed(3))), clientWidth, clientHeight, this.colours]);
    if (looks === this.drawn) return;
    this.drawn = looks;
    this.craft.draw(this.now, this.colours);
  }

  read(context) {
    this.show(context);
  }

  destroy() {
    this.craft.gl?.getExtension("WEBGL_lose_context")?.loseContext(); // a browser has only some of them
  }
}
