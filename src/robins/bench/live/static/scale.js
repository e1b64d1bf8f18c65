// How high a plot is. It shall not jump: it grows at once, and shrinks only when much is left over.
// And it shall show what the bands and limits mean: what is far beyond them is marked at the edge.

const STEPS = [1, 1.5, 2, 3, 4, 5, 6, 8, 10];
const SHARE = 0.98; // of the samples that are to fit; a few wild ones are marked at the edge
const WILD = 1.7; // times as large as that share
const FAR = 12; // a limit this many times beyond the samples is left out
const SHRINK = 0.45;
const BANDS = 6; // times as high as its bands usually are a plot is at most
const LIMITS = 4; // the same of the limit of what has one sign

function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * STEPS.find((step) => step * power >= value * 0.999999);
}

/** Sizes of all numbers, by size. */
function sorted(columns) {
  const sizes = [];
  for (const column of columns)
    for (const value of column) if (value !== undefined && value !== null) sizes.push(Math.abs(value));
  return Float64Array.from(sizes).sort();
}

/** The largest of sorted sizes; where a few are wild, that of the others. */
function usual(sizes) {
  if (!sizes.length) return 0;
  const most = sizes[Math.min(sizes.length - 1, Math.floor(SHARE * sizes.length))];
  const largest = sizes[sizes.length - 1];
  return largest <= WILD * most ? largest : most;
}

export const usualSize = (columns) => usual(sorted(columns));

export class Scale {
  constructor() {
    this.top = 0;
    this.whole = false; // as high as the values are
  }

  /** Fit to values, bands and limits; [least, most], zero always inside. */
  fit(values, bands, limits) {
    const widths = sorted(bands);
    const band = usual(widths);
    const data = Math.max(usualSize(values), band);
    const limit = usualSize(limits);
    const negative = bands.length > 0 || values.some((column) => column.some((value) => value < 0));
    let most = limit <= FAR * data || !data ? Math.max(data, limit) : data;
    if (!this.whole && band) most = Math.min(most, Math.max(band, BANDS * widths[widths.length >> 1]));
    if (!this.whole && limit && !negative) most = Math.min(most, LIMITS * limit);
    if (most > 0) {
      const wanted = roundUp(1.08 * most);
      if (wanted > this.top || 1.08 * most < SHRINK * this.top) this.top = wanted;
    }
    const top = this.top || 1;
    return [negative ? -top : 0, top];
  }
}
