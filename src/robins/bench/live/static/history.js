// The samples of a whole run in constant memory: least and greatest of each signal in buckets.

export const MARK = 0xffffffff; // in place of the number of a sample: it is a history
const BUCKETS = 4096;
const HEAD = 24; // bytes: run, MARK, buckets, signals, samples of a bucket, samples; each u32

/** A bucket holds `per` samples; when all buckets are full, each two become one. */
export class History {
  constructor(signals) {
    const room = () => new Float64Array(BUCKETS).fill(NaN);
    this.samples = 0;
    this.per = 1;
    this.first = room();
    this.last = room();
    this.least = Array.from({ length: signals }, room);
    this.most = Array.from({ length: signals }, room);
  }

  get buckets() {
    return Math.ceil(this.samples / this.per);
  }

  /** Add the sample at an index of columns. */
  add(time, columns, index) {
    if (this.samples === BUCKETS * this.per) this.#halve();
    const b = Math.floor(this.samples / this.per);
    if (this.samples % this.per === 0) this.first[b] = time;
    this.last[b] = time;
    this.samples++;
    for (let k = 0; k < columns.length; k++) {
      const value = columns[k][index];
      if (Number.isNaN(value)) continue;
      if (!(this.least[k][b] <= value)) this.least[k][b] = value;
      if (!(this.most[k][b] >= value)) this.most[k][b] = value;
    }
  }

  /** What the server packed (an ArrayBuffer; little endian as every machine with a browser is). */
  static read(buffer) {
    const [, , buckets, signals, per, samples] = new Uint32Array(buffer, 0, HEAD / 4);
    const rows = new Float64Array(buffer, HEAD);
    const made = new History(signals);
    Object.assign(made, { per, samples });
    [made.first, made.last, ...made.least, ...made.most].forEach((row, k) => row.set(rows.subarray(k * buckets, (k + 1) * buckets)));
    return made;
  }

  #halve() {
    const half = BUCKETS / 2;
    const pair = (row, choose) => {
      for (let b = 0; b < half; b++) row[b] = choose(row[2 * b], row[2 * b + 1]);
      row.fill(NaN, half);
    };
    const other = (a, b, fits) => (Number.isNaN(a) || fits ? b : a); // of two of which some are missing
    pair(this.first, (a) => a);
    pair(this.last, (_, b) => b);
    for (const row of this.least) pair(row, (a, b) => other(a, b, b < a));
    for (const row of this.most) pair(row, (a, b) => other(a, b, b > a));
    this.per *= 2;
  }
}
