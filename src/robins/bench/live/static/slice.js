// A part of a run as it is drawn: not many more points than there are pixels, no spike left out.

const POINTS = 1024; // groups that are drawn of each part

/**
 * Parts have `first` and `last` times, `least` and `most` of each signal, and go from `begin` to
 * `end`. Where there are too many of them, a power of two of neighbours become one group, counted
 * from the start of the run so that the picture moves and does not flicker: two points, of its
 * least and its greatest value.
 */
export class Slice {
  constructor(parts) {
    this.parts = parts.map(grouped).filter((part) => part.begin < part.end);
    const points = this.parts.reduce((sum, part) => sum + part.points, 0);
    this.time = new Float64Array(points);
    let at = 0;
    for (const { first, last, begin, end, group, single } of this.parts)
      for (let i = begin; i < end; i += group) {
        this.time[at++] = first[i];
        if (!single) this.time[at++] = last[Math.min(i + group, end) - 1];
      }
  }

  /**
   * Points of a signal times a factor, as uPlot wants them: a number, undefined where the line
   * goes on to the next one, null where it breaks. A signal that comes seldom is no broken one:
   * the line breaks where nothing came for more than 2.5 of its usual intervals.
   */
  column(k, factor = 1) {
    const out = new Array(this.time.length);
    let at = 0;
    for (const part of this.parts) at = (part.single ? each : extremes)(part, k, factor, out, at);
    const { last, found } = this.#broken(out);
    const newest = this.#newest(k) * factor;
    return { out, found, last: Number.isNaN(newest) && found ? out[last] : newest };
  }

  #broken(out) {
    const { time } = this;
    let first = -1;
    let last = -1;
    let found = 0;
    for (let i = 0; i < out.length; i++) {
      if (out[i] === undefined) continue;
      if (first < 0) first = i;
      last = i;
      found++;
    }
    const most = found > 1 ? (2.5 * (time[last] - time[first])) / (found - 1) : 0;
    for (let i = first + 1, before = first; i <= last && first >= 0; i++) {
      if (out[i] === undefined) continue;
      if (i > before + 1 && time[i] - time[before] > most) out[before + 1] = null;
      before = i;
    }
    return { last, found };
  }

  /** The newest value itself, where samples are kept each. */
  #newest(k) {
    const part = this.parts.at(-1);
    if (!part?.raw) return NaN;
    let i = part.end - 1;
    while (i > part.begin && Number.isNaN(part.least[k][i])) i--;
    return part.least[k][i];
  }
}

function grouped(part) {
  const many = part.end - part.begin;
  let group = 1;
  if (many > (part.raw ? 2 : 1) * POINTS) while (group * POINTS < many) group *= 2;
  const begin = Math.max(0, part.begin - ((part.begin + part.shift) % group));
  const single = Boolean(part.raw) && group === 1;
  return { ...part, begin, group, single, points: (single ? 1 : 2) * Math.max(0, Math.ceil((part.end - begin) / group)) };
}

function each({ least, begin, end }, k, factor, out, at) {
  const column = least[k];
  for (let i = begin; i < end; i++, at++) out[at] = Number.isNaN(column[i]) ? undefined : column[i] * factor;
  return at;
}

function extremes({ least, most, begin, end, group }, k, factor, out, at) {
  const [lows, highs] = [least[k], most[k]];
  let before = 0;
  for (let i = begin; i < end; i += group, at += 2) {
    let low = Infinity;
    let high = -Infinity;
    for (let j = Math.min(i + group, end) - 1; j >= i; j--) {
      if (lows[j] < low) low = lows[j];
      if (highs[j] > high) high = highs[j];
    }
    if (low > high) out[at] = out[at + 1] = undefined;
    else {
      const rising = Math.abs(low - before) <= Math.abs(high - before); // the nearer one first
      out[at] = (rising ? low : high) * factor;
      before = rising ? high : low;
      out[at + 1] = before * factor;
    }
  }
  return at;
}
