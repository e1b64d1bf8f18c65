// Quaternions, scalar first, as arrays [w, x, y, z].

export const multiply = ([a, b, c, d], [w, x, y, z]) => [
  a * w - b * x - c * y - d * z,
  a * x + b * w + c * z - d * y,
  a * y - b * z + c * w + d * x,
  a * z + b * y - c * x + d * w,
];

/** A turn by an angle [rad] about a unit vector. */
export const turn = (angle, axis) => [Math.cos(angle / 2), ...axis.map((u) => u * Math.sin(angle / 2))];

/** Of length one; null where it is not known. */
export function normalised(q) {
  const length = Math.hypot(...q);
  return length > 0.5 && length < 2 ? q.map((u) => u / length) : null;
}

/** The angle [rad] between two attitudes; exact for small ones too. */
export function angleBetween([w, ...v], q) {
  const [scalar, ...vector] = multiply([w, ...v.map((u) => -u)], q);
  return 2 * Math.atan2(Math.hypot(...vector), Math.abs(scalar));
}
