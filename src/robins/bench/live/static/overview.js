// The whole run as a strip: what is shown of it, its events and faults; a click goes there.

export class Overview {
  constructor(canvas, timeline) {
    Object.assign(this, { canvas, timeline });
    const go = (event) => {
      const box = canvas.getBoundingClientRect();
      timeline.go(((event.clientX - box.left) / box.width) * this.end);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      go(event);
    });
    canvas.addEventListener("pointermove", (event) => event.buttons && go(event));
  }

  get end() {
    return Math.max(this.timeline.now, this.timeline.span[1], 1e-9);
  }

  draw({ spans, events }, colours) {
    const { canvas, timeline } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * devicePixelRatio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const ctx = canvas.getContext("2d");
    const at = (time) => (time / this.end) * width;
    ctx.clearRect(0, 0, width, height);
    ctx.fillStyle = colours.lines[0];
    const [left, right] = timeline.span.map(at);
    ctx.globalAlpha = 0.25;
    ctx.fillRect(left, 0, Math.max(right - left, 2 * devicePixelRatio), height);
    ctx.fillStyle = colours.fault;
    ctx.globalAlpha = 0.6;
    for (const { begin_s: begin, end_s: end } of spans) {
      const from = at(begin);
      ctx.fillRect(from, 0, Math.max(at(end ?? timeline.now) - from, devicePixelRatio), height / 3);
    }
    ctx.globalAlpha = 1;
    for (const level of ["info", "warning", "alarm"]) {
      ctx.fillStyle = colours.levels[level];
      for (const event of events)
        if (event.level === level) ctx.fillRect(at(event.time_s), height / 3, devicePixelRatio, (2 * height) / 3);
    }
  }
}
