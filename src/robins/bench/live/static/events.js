// The list of events, and the line of alarms that wait to be acknowledged.

import { clock, count, element, say, seconds } from "./format.js";

const byId = (id) => document.getElementById(id);
const MOST = 200;

/** Events, and how often each came. */
const words = ({ text, count: times }) => (times > 1 ? `${text}  ×${count(times)}` : text);

export class EventList {
  /** `go(event)` shows its time; `acknowledge(ids)` is requested; `changed()` says that it is another list. */
  constructor({ go, acknowledge, changed }) {
    this.list = byId("events");
    this.lines = new Map(); // by id, the oldest first
    Object.assign(this, { go, changed });
    this.list.addEventListener("click", (event) => {
      const line = event.target.closest("li");
      if (!line) return;
      const { event: said } = this.lines.get(line.dataset.id);
      if (event.target.closest("[data-acknowledge]")) acknowledge([said.id]);
      else this.go(said);
    });
    this.list.addEventListener("keydown", (event) => this.#walk(event));
    byId("acknowledge").addEventListener("click", () => this.acknowledgeAll());
    this.acknowledgeAll = () => this.waiting.length && acknowledge(this.waiting.map((one) => one.id));
  }

  /** All events, the oldest first. */
  get all() {
    return [...this.lines.values()].map((one) => one.event);
  }

  /** Alarms that are not acknowledged. */
  get waiting() {
    return this.all.filter((one) => one.level === "alarm" && !one.acknowledged);
  }

  /** Start again with what is known. */
  show(events) {
    this.list.replaceChildren();
    this.lines.clear();
    for (const event of events) this.#put(event);
    this.#tell();
  }

  /** A line more, or more of a line. */
  add(event) {
    this.#put(event);
    this.#tell();
  }

  acknowledged(ids) {
    for (const id of ids) {
      const known = this.lines.get(String(id));
      if (known) this.#put({ ...known.event, acknowledged: true });
    }
    this.#tell();
  }

  /** Mark the line of an event, which is the one that plots show bold. */
  choose(id) {
    for (const [key, { line }] of this.lines) line.classList.toggle("chosen", key === String(id));
  }

  #put(event) {
    const key = String(event.id);
    const known = this.lines.get(key);
    const line = this.#line(event, key);
    if (known) known.line.replaceWith(line);
    else this.list.prepend(line);
    this.lines.set(key, { event, line });
    if (this.lines.size > MOST) this.#forgetOne();
  }

  #line(event, key) {
    const { level, time_s: time, until_s: until } = event;
    const at = element("button", "time", clock(time, time < 60 ? 0.1 : 1));
    at.type = "button";
    at.tabIndex = -1; // the arrow keys go from line to line
    at.title = until === undefined ? `at ${time} s: show it` : `${time} s to ${until} s: show it`;
    const line = element("li", level, at, element("span", "", words(event)));
    if (level === "alarm" && !event.acknowledged) {
      line.classList.add("waiting");
      const button = element("button", "small", "Acknowledge");
      Object.assign(button, { type: "button", tabIndex: -1 });
      button.dataset.acknowledge = "";
      line.append(button);
    }
    Object.assign(line.dataset, { id: key, level });
    return line;
  }

  /** A frequent level must not push out a rare one. */
  #forgetOne() {
    const ids = {};
    for (const [key, { event }] of this.lines) (ids[event.level] ??= []).push(key);
    const most = Object.values(ids).reduce((a, b) => (b.length > a.length ? b : a));
    this.lines.get(most[0]).line.remove();
    this.lines.delete(most[0]);
  }

  #walk(event) {
    const step = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const lines = [...this.list.children];
    const at = lines.indexOf(document.activeElement.closest("li"));
    lines[Math.min(lines.length - 1, Math.max(0, at + step))]?.querySelector("button").focus();
  }

  /** The alarm line: the newest alarm that waits, else the newest of all. */
  #tell() {
    const { waiting } = this;
    const shown = waiting.at(-1) ?? this.all.filter((one) => one.level === "alarm").at(-1);
    say(byId("alarm-text"), shown ? `${seconds(shown.time_s)}  ${words(shown)}` : "no alarm");
    say(byId("alarm-tally"), waiting.length ? `${count(waiting.length)} not acknowledged` : shown ? "acknowledged" : "");
    say(byId("acknowledge"), waiting.length > 1 ? `Acknowledge all ${count(waiting.length)}` : "Acknowledge");
    byId("acknowledge").hidden = !waiting.length;
    byId("alarm").dataset.level = waiting.length ? "alarm" : shown ? "old" : "none";
    this.changed();
  }
}
