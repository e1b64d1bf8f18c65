// Numbers and small pieces of the page.

const DASH = "–";

/** Decimals that show a range with about three figures. */
export function decimalsFor(range) {
  return Math.min(6, Math.max(0, Math.floor(3 - Math.log10(range || 1))));
}

/** A number with these decimals; very small ranges go by powers of ten. */
export function number(value, decimals = 1) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || (decimals >= 6 && size < 1e-2))) return minus(value.toExponential(1));
  return minus((size < 0.5 * 10 ** -decimals ? 0 : value).toFixed(decimals));
}

/** A count, in groups of three. */
export function count(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return DASH;
  return Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

const two = (value) => String(Math.floor(value)).padStart(2, "0");

/** Seconds in words: "12.3 s", "2 min 03 s", "2 h 03 min". */
export function seconds(value, decimals = 1) {
  if (!Number.isFinite(value)) return DASH;
  if (Math.abs(value) < 59.95) return minus(`${value.toFixed(decimals)} s`);
  const whole = Math.round(Math.abs(value));
  const sign = value < 0 ? "-" : "";
  if (whole < 3600) return minus(`${sign}${Math.floor(whole / 60)} min ${two(whole % 60)} s`);
  return minus(`${sign}${Math.floor(whole / 3600)} h ${two((whole % 3600) / 60)} min`);
}

/**
 * A time of the run, short and as fine as `step`: "12.3 s", "5 min", "5:07 min", "2 h", "2:15 h",
 * "2:15:07 h".
 */
export function clock(value, step = 0.1) {
  if (!Number.isFinite(value)) return DASH;
  const decimals = step >= 1 ? 0 : Math.min(3, Math.ceil(-Math.log10(step) - 1e-9));
  const rounded = Number(Math.abs(value).toFixed(decimals));
  const rest = (rounded % 60).toFixed(decimals).padStart(decimals ? decimals + 3 : 2, "0");
  const minutes = Math.floor(rounded / 60);
  const sign = value < 0 && rounded ? "\u2212" : "";
  if (rounded < 60) return `${sign}${rounded.toFixed(decimals)}\u202fs`;
  if (rounded < 3600) return `${sign}${minutes}${step % 60 ? `:${rest}` : ""}\u202fmin`;
  const hours = Math.floor(minutes / 60);
  const fine = step % 60 ? `:${two(minutes % 60)}:${rest}` : step % 3600 ? `:${two(minutes % 60)}` : "";
  return `${sign}${hours}${fine}\u202fh`;
}

/** Steps between two ticks of an axis of time [s]. */
export const TIME_STEPS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400, 172800];

/** A number at an axis that goes up to `top`; short, whatever that is. */
export function tick(value, top) {
  if (value === 0) return "0";
  if (top < 1e-3 || top >= 1e6) return minus(value.toExponential(0));
  const [size, mark] = top >= 1e4 ? [1e3, "k"] : [1, ""];
  return `${minus(String(Number((value / size).toPrecision(5))))}${mark}`;
}

/** With a minus sign in place of a hyphen. */
function minus(text) {
  return text.replace(/^-/, "\u2212");
}

/** An element with a class, a text and children. */
export function element(tag, className = "", ...children) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  made.append(...children);
  return made;
}

/** Set a text only where it changed, so that nothing is laid out for nothing. */
export function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}
