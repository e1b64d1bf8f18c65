// The samples of a run, of constant size however long it is: the latest each, those before as a history.

import { History } from "./history.js";
import { Slice } from "./slice.js";

const MOST = 24000; // of each signal; 20 minutes at 20 a second
const NARROW = 0.1; // a bucket whose values differ by less has a value

/** Index of the first of some sorted times that is not before a time. */
function firstFrom(times, length, time) {
  let low = 0;
  let high = length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

export class Samples {
  constructor(signals, past = new History(signals)) {
    this.past = past;
    this.time = new Float64Array(2 * MOST);
    this.values = Array.from({ length: signals }, () => new Float64Array(2 * MOST));
    this.length = 0;
    this.forgotten = 0; // samples that went into the history
  }

  /** Add a sample: a view of its values, little endian, and its time. */
  add(time, view, at) {
    if (this.length === 2 * MOST) this.#forget();
    const n = this.length++;
    this.time[n] = time;
    this.values.forEach((column, k) => {
      const value = view.getFloat64(at + 8 * k, true);
      column[n] = Number.isFinite(value) ? value : NaN;
    });
  }

  get last() {
    if (this.length) return this.time[this.length - 1];
    return this.past.samples ? this.past.last[this.past.buckets - 1] : NaN;
  }

  /** Index of the first sample not before a time. */
  from(time) {
    return firstFrom(this.time, this.length, time);
  }

  /** What is to be drawn of a span of time, and one sample more on each side. */
  slice(from, to) {
    const { past } = this;
    const begin = this.from(from);
    const parts = [];
    if (past.samples && begin === 0) {
      const first = Math.max(0, firstFrom(past.last, past.buckets, from) - 1);
      const end = Math.min(past.buckets, firstFrom(past.first, past.buckets, to) + 1);
      parts.push({ ...past, begin: first, end, shift: 0, raw: past.per === 1 });
    }
    const end = Math.min(this.length, this.from(to) + 1);
    const raw = { first: this.time, last: this.time, least: this.values, most: this.values, raw: true };
    parts.push({ ...raw, begin: Math.max(0, begin - 1), end, shift: this.forgotten });
    return new Slice(parts);
  }

  /** A signal at a time, or its last value; NaN where it is not known. */
  valueAt(k, time) {
    const column = this.values[k];
    if (this.length && time >= this.time[0]) {
      let i = Math.min(this.from(time), this.length - 1);
      if (this.time[i] > time) i--;
      while (i > 0 && Number.isNaN(column[i])) i--;
      return column[i];
    }
    const { past } = this;
    const b = firstFrom(past.last, past.buckets, time);
    if (b === past.buckets) return NaN;
    const [least, most] = [past.least[k][b], past.most[k][b]];
    return most - least < NARROW ? (least + most) / 2 : NaN;
  }

  #forget() {
    for (let i = 0; i < MOST; i++) this.past.add(this.time[i], this.values, i);
    for (const column of [this.time, ...this.values]) column.copyWithin(0, MOST, 2 * MOST);
    this.length = MOST;
    this.forgotten += MOST;
  }
}
