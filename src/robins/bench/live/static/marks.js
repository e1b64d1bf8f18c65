// Events and faults on plots: bands behind the lines, vertical marks before them.

const BAND_TEXT = 40; // pixels: a narrower band is not named

/** Bands of the time in which faults were on; `open` ones last until `now`. */
export function drawBands({ ctx, bbox }, span, spans, now, colours, named) {
  const at = (time) => bbox.left + ((time - span[0]) / (span[1] - span[0])) * bbox.width;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
  Object.assign(ctx, { textAlign: "left", textBaseline: "bottom" });
  for (const { label, begin_s: begin, end_s: end } of spans) {
    const left = Math.max(bbox.left, at(begin));
    const right = Math.max(left + devicePixelRatio, at(end ?? now));
    if (right < bbox.left || left > bbox.left + bbox.width) continue;
    ctx.fillStyle = colours.fault;
    ctx.globalAlpha = 0.14;
    ctx.fillRect(left, bbox.top, right - left, bbox.height);
    ctx.globalAlpha = 0.9;
    ctx.fillRect(left, bbox.top, right - left, 2 * devicePixelRatio);
    const room = Math.min(right, bbox.left + bbox.width) - left;
    if (!named || room < BAND_TEXT * devicePixelRatio) continue;
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, bbox.top, room, bbox.height);
    ctx.clip();
    ctx.fillText(label, left + 3 * devicePixelRatio, bbox.top + bbox.height - 2 * devicePixelRatio);
    ctx.restore();
  }
  ctx.restore();
}

/** A line at each event; the selected one is whole and bold. */
export function drawEvents({ ctx, bbox }, span, events, chosen, colours) {
  ctx.save();
  for (const { time_s: time, level, id } of events) {
    const x = bbox.left + ((time - span[0]) / (span[1] - span[0])) * bbox.width;
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    const bold = id === chosen;
    ctx.strokeStyle = colours.levels[level] ?? colours.text;
    ctx.globalAlpha = bold ? 1 : level === "info" ? 0.45 : 0.75;
    ctx.lineWidth = (bold ? 2 : 1) * devicePixelRatio;
    ctx.setLineDash(bold ? [] : [2 * devicePixelRatio, 3 * devicePixelRatio]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  }
  ctx.restore();
}
