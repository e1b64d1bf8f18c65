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

/** Seconds since the start of the run. */
export function seconds(value, decimals = 1) {
  return Number.isFinite(value) ? `${value.toFixed(decimals)} s` : DASH;
}

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
