/**
 * The side panel: one panel at a time, opened by a button or a key. The modules of a panel are loaded when it is opened
 * first: most visits need none of them.
 */

import { announce, byId, makeText, setText } from "./dom.js";

/** @typedef {"recordings" | "sync" | "doctor" | "controls" | "calibration" | "signals" | "episodes"} PanelName */

/** @typedef {{title: string, load: () => Promise<Panel>}} PanelPlace */

/**
 * @typedef {Object} Panel
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
  /** @type {Map<PanelName, Promise<Panel>>} one of each: a panel that is asked for twice is made once */
  #loads = new Map();
  /** @type {Map<PanelName, Panel>} */
  #loaded = new Map();
  /** @type {Element | null} what had the focus before */
  #focused = null;
  #places;

  /** @param {Record<PanelName, PanelPlace>} places */
  constructor(places) {
    this.#places = places;
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
    if (this.#shown === null) {
      this.#focused = document.activeElement;
    } else {
      this.#loaded.get(this.#shown)?.close();
    }
    this.#shown = name;
    setText(this.#title, this.#places[name].title);
    this.#body.replaceChildren();
    this.#show();
    this.#title.focus();
    void this.#fill(name);
  }

  /** @param {PanelName} name */
  async #fill(name) {
    const load = this.#loads.get(name) ?? this.#places[name].load();
    this.#loads.set(name, load);
    /** @type {Panel} */
    let panel;
    try {
      panel = await load;
    } catch {
      this.#loads.delete(name);
      if (this.#shown === name) {
        const text = "This panel was not loaded: the daemon does not answer. Reload the page when it does.";
        this.#body.replaceChildren(makeText("p", "said", text));
      }
      return;
    }
    this.#loaded.set(name, panel);
    if (this.#shown === name && panel.element.parentElement !== this.#body) {
      this.#body.replaceChildren(panel.element);
      panel.open();
      this.#body.scrollTop = 0;
    }
  }

  close() {
    if (this.#shown === null) {
      return;
    }
    this.#loaded.get(this.#shown)?.close();
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
      this.#loaded.get(this.#shown)?.update?.(status);
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
