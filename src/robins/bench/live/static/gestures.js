// The timeline by mouse, finger and keyboard.

const KEY_SHARE = 0.25;
const ZOOM = 1.5;
const DRAG = 4; // pixels; less is a click
const WHEEL = 0.002; // of the exponent of a zoom

/** What keys do; `actions` are functions of these names. */
const KEYS = {
  ArrowLeft: ["move", -KEY_SHARE],
  ArrowRight: ["move", KEY_SHARE],
  "+": ["zoom", 1 / ZOOM],
  "=": ["zoom", 1 / ZOOM],
  "-": ["zoom", ZOOM],
  Home: ["begin"],
  End: ["follow"],
  l: ["follow"],
  h: ["hold"],
  a: ["acknowledge"],
};

function onKeys(actions) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
    if (event.target.closest("input, select, textarea")) return;
    const found = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
    if (!found) return;
    event.preventDefault();
    actions[found[0]](found[1]);
  });
}

/** Where in the plot, as a share of its width. */
function shareAt(event, over) {
  const box = over.getBoundingClientRect();
  return (event.clientX - box.left) / box.width;
}

/** Drag the plots of a place, zoom them with Ctrl and the wheel, move them with a sideways wheel. */
function onPlots(place, timeline) {
  let drag = null;
  place.addEventListener("pointerdown", (event) => {
    const over = event.target.closest(".u-over");
    if (over && event.button === 0) drag = { over, x: event.clientX, moved: false };
  });
  place.addEventListener("pointermove", (event) => {
    if (!drag || (!drag.moved && Math.abs(event.clientX - drag.x) < DRAG)) return;
    if (!drag.moved) drag.over.setPointerCapture(event.pointerId);
    timeline.move((drag.x - event.clientX) / drag.over.clientWidth);
    Object.assign(drag, { x: event.clientX, moved: true });
  });
  for (const end of ["pointerup", "pointercancel"]) place.addEventListener(end, () => (drag = null));
  place.addEventListener(
    "wheel",
    (event) => {
      const over = event.target.closest(".u-over");
      const sideways = Math.abs(event.deltaX) > Math.abs(event.deltaY);
      if (!over || !(event.ctrlKey || event.metaKey || sideways)) return;
      event.preventDefault();
      if (sideways) timeline.move(event.deltaX / over.clientWidth);
      else timeline.zoom(Math.exp(WHEEL * event.deltaY), shareAt(event, over));
    },
    { passive: false },
  );
}

/** Join a timeline with the plots of a place, the buttons of a bar, and the keyboard. */
export function wire(timeline, place, bar, acknowledge) {
  const actions = {
    move: (share) => timeline.move(share),
    zoom: (factor) => timeline.zoom(factor),
    begin: () => timeline.go(0),
    follow: () => timeline.follow(),
    hold: () => (timeline.live ? timeline.hold() : timeline.follow()),
    back: () => timeline.move(-KEY_SHARE),
    on: () => timeline.move(KEY_SHARE),
    closer: () => timeline.zoom(1 / ZOOM),
    wider: () => timeline.zoom(ZOOM),
    acknowledge,
  };
  onKeys(actions);
  onPlots(place, timeline);
  bar.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-view]");
    if (button) actions[button.dataset.view]();
  });
}
