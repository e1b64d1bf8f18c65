// Commands of the page to the bench.

import { say } from "./format.js";

const SURE_MS = 3000;
const RUNNING = new Set(["running"]);
const OVER = new Set(["stopped", "failed"]);

const answer = document.getElementById("answer");
const form = document.getElementById("inject");

let before = "";
let times = 0;

/** Show the outcome of a command; repeated ones are counted. */
export function told(text, good) {
  times = text === before ? times + 1 : 1;
  before = text;
  say(answer, times > 1 ? `${text} (${times} times)` : text);
  answer.classList.toggle("alarm", !good);
}

/** Grey what makes no sense now. It stays focusable, so that the keyboard does not lose its place. */
export function allow(open, state) {
  const off = {
    start: !open || RUNNING.has(state) || OVER.has(state),
    pause: !open || state === "paused" || OVER.has(state),
    stop: !open || OVER.has(state),
    clear: !open || OVER.has(state),
    say: !open || OVER.has(state),
  };
  for (const button of document.querySelectorAll("button[data-do]"))
    button.setAttribute("aria-disabled", String(off[button.dataset.do]));
  form.querySelector("[type=submit]").setAttribute("aria-disabled", String(off.clear || form.classList.contains("none")));
}

/** Join the buttons with what sends a command; gives a function that sends another, and reports a failure. */
export function wire(send) {
  const press = (command) => {
    if (!send(command)) told("not sent: the page has no server now", false);
  };
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-do]");
    if (!button || button.getAttribute("aria-disabled") === "true") return;
    const { do: what, label } = button.dataset;
    if (what === "stop" && !sure(button)) return;
    press(label ? { do: what, label } : { do: what });
  });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (form.querySelector("[type=submit]").getAttribute("aria-disabled") === "true") return;
    const length = document.getElementById("duration").value;
    press({ do: "inject", label: document.getElementById("fault").value, duration_s: length === "" ? null : Number(length) });
  });
  return press;
}

/** Stop ends the run, so it is pressed twice. */
function sure(button) {
  if (button.dataset.sure) {
    delete button.dataset.sure;
    button.textContent = "Stop";
    return true;
  }
  button.dataset.sure = "yes";
  button.textContent = "Sure?";
  setTimeout(() => {
    delete button.dataset.sure;
    button.textContent = "Stop";
  }, SURE_MS);
  return false;
}
