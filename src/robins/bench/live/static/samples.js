// The samples that are kept: by signal, of constant size however long the bench runs.

const MOST = 24000; // of each signal; 20 minutes at 20 a second

export class Samples {
  constructor(signals) {
    this.time = new Float64Array(2 * MOST);
    this.values = Array.from({ length: signals }, () => new Float64Array(2 * MOST));
    this.length = 0;
  }

  /** Add a sample: a view of its values, little endian, and its time. */
  add(time, view, at) {
    if (this.length === 2 * MOST) this.#forget();
    const n = this.length++;
    this.time[n] = time;
    this.values.forEach((column, k) => {
      column[n] = view.getFloat64(at + 8 * k, true);
    });
  }

  get last() {
    return this.length ? this.time[this.length - 1] : NaN;
  }

  /** Index of the first sample not before a time. */
  from(time) {
    let low = 0;
    let high = this.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /**
   * Samples of a signal from an index on, times a factor, as uPlot wants them: a number, undefined
   * where the line goes on to the next one, null where it breaks. A signal that comes seldom is
   * no broken one: the line breaks where nothing came for more than 2.5 of its usual intervals.
   */
  column(k, start, factor = 1) {
    const { time, length } = this;
    const column = this.values[k];
    const out = new Array(length - start);
    let first = -1;
    let last = -1;
    let found = 0;
    for (let i = start; i < length; i++) {
      const value = column[i];
      if (Number.isFinite(value)) {
        out[i - start] = value * factor;
        if (first < 0) first = i;
        last = i;
        found++;
      } else out[i - start] = undefined;
    }
    const usual = found > 1 ? (time[last] - time[first]) / (found - 1) : 0;
    const most = 2.5 * usual;
    for (let i = first + 1, before = first; i <= last && first >= 0; i++) {
      if (out[i - start] === undefined) continue;
      if (i > before + 1 && time[i] - time[before] > most) out[before + 1 - start] = null;
      before = i;
    }
    return { out, found, last: last < 0 ? NaN : column[last] * factor };
  }

  #forget() {
    for (const column of [this.time, ...this.values]) column.copyWithin(0, MOST, 2 * MOST);
    this.length = MOST;
  }
}
