// Which plots and signals are shown. It is kept in the address, so that a link or a bookmark has it.

import { element } from "./format.js";

const PLOT = "hide-plot";
const SIGNAL = "hide-signal";

const read = () => new URLSearchParams(location.hash.slice(1));

export class Choice {
  /** `place` gets the boxes; `changed()` is called when others are chosen. */
  constructor(place, changed) {
    Object.assign(this, { place, changed });
    this.#take();
    place.addEventListener("change", ({ target }) => this.set(target.dataset.kind, target.value, target.checked));
    addEventListener("hashchange", () => {
      this.#take();
      this.#tick();
      this.changed();
    });
  }

  /** Offer what there is: signals by plot. */
  offer(signals) {
    const box = (kind, value, text) => {
      const input = element("input");
      Object.assign(input, { type: "checkbox", value });
      input.dataset.kind = kind;
      return element("label", "", input, text);
    };
    const titles = [...new Set(signals.map((s) => s.plot))];
    this.place.replaceChildren(
      ...titles.map((title) => {
        const own = signals.filter((s) => s.plot === title && s.role === "value");
        const boxes = own.length > 1 ? own.map((s) => box(SIGNAL, s.name, s.name)) : [];
        return element("fieldset", "", element("legend", "", box(PLOT, title, title)), ...boxes);
      }),
    );
    this.#tick();
  }

  shows(title) {
    return !this.hidden[PLOT].has(title);
  }

  /** Names of signals that are not shown. */
  get signals() {
    return this.hidden[SIGNAL];
  }

  toggleSignal(name) {
    this.set(SIGNAL, name, this.signals.has(name));
  }

  set(kind, name, shown) {
    if (shown) this.hidden[kind].delete(name);
    else this.hidden[kind].add(name);
    const kept = read();
    for (const one of [PLOT, SIGNAL]) {
      kept.delete(one);
      for (const hidden of this.hidden[one]) kept.append(one, hidden);
    }
    history.replaceState(null, "", `#${kept}`);
    this.#tick();
    this.changed();
  }

  #take() {
    const said = read();
    this.hidden = { [PLOT]: new Set(said.getAll(PLOT)), [SIGNAL]: new Set(said.getAll(SIGNAL)) };
  }

  #tick() {
    for (const input of this.place.querySelectorAll("input")) input.checked = !this.hidden[input.dataset.kind].has(input.value);
  }
}
