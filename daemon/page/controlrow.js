/** One control of a camera: a slider with a number, a switch or a menu. */

import { make, makeText, setState, setText } from "./dom.js";
import { controlFacts, differsFromFile, valueText, whyNotSet } from "./controltext.js";

/** @typedef {import("./paneltypes.js").Control} Control */
/** @typedef {import("./paneltypes.js").ControlValue} ControlValue */

/** A value that was read before the hand moved must not move the slider back. */
const SETTLE_MS = 1000;

let made = 0;

export class ControlRow {
  element = make("div", "control");
  #label;
  #facts = make("p", "quiet");
  #why = make("p", "why");
  /** @type {HTMLInputElement | HTMLSelectElement} */
  #input;
  /** @type {HTMLInputElement | null} the number beside a slider */
  #number = null;
  #touchedAt = -Infinity;
  #isTyped = false;
  #isAsking = false;
  /** @type {ControlValue | null} the newest value while another is being set */
  #wanted = null;
  #set;

  /**
   * @param {Control} control
   * @param {(name: string, value: ControlValue) => Promise<void>} set
   */
  constructor(control, set) {
    this.control = control;
    this.#set = set;
    made += 1;
    const id = `control-${made}`;
    this.#label = makeText("label", "", control.name);
    this.#label.htmlFor = id;
    this.#input = inputOf(control);
    this.#input.id = id;
    const line = make("div", "control-line");
    line.append(this.#label, this.#input);
    if (control.kind === "integer") {
      const number = document.createElement("input");
      number.type = "number";
      number.setAttribute("aria-label", `${control.name}, as a number`);
      number.addEventListener("input", () => (this.#isTyped = true));
      number.addEventListener("change", () => this.#typed(number));
      line.append(number);
      this.#number = number;
    }
    const when = control.kind === "integer" ? "input" : "change";
    this.#input.addEventListener(when, () => void this.#changed(this.#read()));
    this.element.dataset.name = control.name;
    this.element.append(line, this.#facts, this.#why);
    this.update(control);
  }

  /** @returns {ControlValue} */
  #read() {
    if (this.#input instanceof HTMLSelectElement) {
      const chosen = this.control.items?.[this.#input.selectedIndex];
      // A menu's value may be a name or a number; the daemon gets what it uses itself.
      return typeof this.control.value === "string" ? (chosen?.name ?? "") : (chosen?.value ?? 0);
    }
    return this.control.kind === "boolean" ? this.#input.checked : this.#input.valueAsNumber;
  }

  /** @param {HTMLInputElement} number */
  #typed(number) {
    this.#isTyped = false;
    const value = number.valueAsNumber;
    if (Number.isFinite(value)) {
      void this.#changed(value);
    } else {
      this.#showValue();
    }
  }

  /**
   * Sets a value. While one is being set only the newest of the others is kept.
   *
   * @param {ControlValue} value
   */
  async #changed(value) {
    this.#touchedAt = performance.now();
    this.#wanted = value;
    this.control = { ...this.control, value };
    this.#showValue();
    if (this.#isAsking) {
      return;
    }
    this.#isAsking = true;
    while (this.#wanted !== null) {
      const wanted = this.#wanted;
      this.#wanted = null;
      await this.#set(this.control.name, wanted);
    }
    this.#isAsking = false;
  }

  /** Takes what the daemon says next, also while the hand is on the control: it refused a value. */
  release() {
    this.#touchedAt = -Infinity;
    this.#wanted = null;
  }

  /** @param {Control} control */
  update(control) {
    const isHeld = this.#wanted !== null || performance.now() - this.#touchedAt < SETTLE_MS;
    this.control = isHeld ? { ...control, value: this.control.value } : control;
    setText(this.#facts, controlFacts(control));
    setText(this.#why, whyNotSet(control));
    setState(this.element, whyNotSet(control) !== "" ? "inactive" : differsFromFile(this.control) ? "changed" : "same");
    const isDisabled = whyNotSet(control) !== "";
    this.#input.disabled = isDisabled;
    if (this.#number !== null) {
      this.#number.disabled = isDisabled;
    }
    if (!isHeld) {
      this.#showValue();
    }
  }

  #showValue() {
    const { value, items, kind } = this.control;
    if (value === null) {
      return;
    }
    if (this.#input instanceof HTMLSelectElement) {
      const at = items?.findIndex((item) => item.value === value || item.name === value) ?? -1;
      this.#input.selectedIndex = at;
    } else if (kind === "boolean") {
      this.#input.checked = value === true || value === 1;
    } else {
      this.#input.value = String(value);
      this.#input.setAttribute("aria-valuetext", valueText(this.control, value));
    }
    if (this.#number !== null && !this.#isTyped) {
      this.#number.value = String(value);
    }
  }
}

/** @param {Control} control */
function inputOf(control) {
  if (control.kind === "menu") {
    const select = document.createElement("select");
    select.append(...(control.items ?? []).map((item) => makeText("option", "", item.name)));
    return select;
  }
  const input = document.createElement("input");
  input.type = control.kind === "boolean" ? "checkbox" : "range";
  if (control.kind === "integer") {
    input.min = String(control.minimum ?? 0);
    input.max = String(control.maximum ?? 100);
    input.step = String(Math.max(1, control.step ?? 1));
  }
  return input;
}
