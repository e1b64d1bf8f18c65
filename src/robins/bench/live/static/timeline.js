// The span of time that the plots show: the latest of the run, or one that is held.

const SHORTEST = 0.5; // s
const LEAST_WHOLE = 10; // s: a run that has just started does not fill all

export class Timeline {
  /** `changed()` is called when another span is to be drawn. */
  constructor(changed) {
    this.changed = changed;
    this.length = 60; // s; Infinity: the whole run
    this.held = null; // [from, to]
    this.now = 0; // time of the newest sample
  }

  get live() {
    return this.held === null;
  }

  /** [from, to] that is shown. */
  get span() {
    if (this.held) return this.held;
    const length = Math.min(this.length, Math.max(this.now, LEAST_WHOLE));
    return [Math.max(0, this.now - length), Math.max(length, this.now)];
  }

  follow() {
    this.#set(null);
  }

  hold() {
    this.#set(this.span);
  }

  /** Show so many seconds; those up to the same time where plots are held. */
  show(length) {
    this.length = length;
    if (!this.held) return this.changed();
    const [, to] = this.held;
    return length === Infinity ? this.#set([0, Math.max(this.now, LEAST_WHOLE)]) : this.#fit(to - length, length);
  }

  /** Go on by a share of what is shown; back where it is negative. */
  move(share) {
    const [from, to] = this.span;
    this.#fit(from + share * (to - from), to - from);
  }

  /** Show a `factor` of what is shown; what is at a share of it stays where it is. */
  zoom(factor, share = 0.5) {
    const [from, to] = this.span;
    const length = Math.max(SHORTEST, factor * (to - from));
    this.#fit(from + share * (to - from - length), length);
  }

  /** Show a time in the middle. */
  go(time) {
    const [from, to] = this.span;
    // of the whole run a part is shown, or nothing would move
    const length = from <= 0 && to >= this.now ? Math.min(to - from, 60) : to - from;
    this.#fit(time - length / 2, length);
  }

  /** Hold a span of that length inside the run, or inside what is shown where that is more. */
  #fit(from, length) {
    const end = Math.max(this.now, this.span[1]);
    const inside = Math.min(length, end);
    const begin = Math.min(Math.max(0, from), end - inside);
    this.#set([begin, begin + inside]);
  }

  #set(held) {
    this.held = held;
    this.changed();
  }
}
