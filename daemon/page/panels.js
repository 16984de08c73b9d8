/** The side panel: one panel at a time, opened by a button or a key. */

import { announce, byId, setText } from "./dom.js";

/** @typedef {"recordings" | "sync" | "doctor" | "controls" | "calibration"} PanelName */

/**
 * @typedef {Object} Panel
 * @property {string} title
 * @property {HTMLElement} element
 * @property {() => void} open it is shown now
 * @property {() => void} close
 * @property {(status: import("./types.js").Status) => void} [update]
 */

export class Panels {
  #aside = byId("panel", HTMLElement);
  #title = byId("panel-title", HTMLElement);
  #body = byId("panel-body", HTMLElement);
  #buttons = [...document.querySelectorAll("#panel-buttons button")].filter((b) => b instanceof HTMLButtonElement);
  /** @type {PanelName | null} */
  #shown = null;
  /** @type {Element | null} what had the focus before */
  #focused = null;
  #panels;

  /** @param {Record<PanelName, Panel>} panels */
  constructor(panels) {
    this.#panels = panels;
    byId("panel-close", HTMLButtonElement).addEventListener("click", () => this.close());
    for (const button of this.#buttons) {
      button.addEventListener("click", () => this.toggle(/** @type {PanelName} */ (button.dataset.panel)));
    }
  }

  get isOpen() {
    return this.#shown !== null;
  }

  /** @param {PanelName} name */
  toggle(name) {
    if (this.#shown === name) {
      this.close();
      return;
    }
    const before = this.#shown;
    if (before === null) {
      this.#focused = document.activeElement;
    } else {
      this.#panels[before].close();
    }
    this.#shown = name;
    const panel = this.#panels[name];
    setText(this.#title, panel.title);
    this.#body.replaceChildren(panel.element);
    this.#show();
    panel.open();
    this.#body.scrollTop = 0;
    this.#title.focus();
  }

  close() {
    if (this.#shown === null) {
      return;
    }
    this.#panels[this.#shown].close();
    this.#shown = null;
    this.#body.replaceChildren();
    this.#show();
    announce("Panel closed");
    if (this.#focused instanceof HTMLElement && this.#focused.isConnected) {
      this.#focused.focus();
    }
  }

  /** @param {import("./types.js").Status} status */
  update(status) {
    if (this.#shown !== null) {
      this.#panels[this.#shown].update?.(status);
    }
  }

  #show() {
    this.#aside.hidden = this.#shown === null;
    document.body.classList.toggle("has-panel", this.#shown !== null);
    for (const button of this.#buttons) {
      button.setAttribute("aria-expanded", String(button.dataset.panel === this.#shown));
    }
  }
}
