/** The bar of the 3-D view: which cameras, colours, how many points, which way is up. */

import { AXES } from "./cloudscene.js";
import { byId, make } from "./dom.js";

/** @typedef {import("./cloudsource.js").CloudSource} CloudSource */
/** @typedef {import("./cloudgl.js").Paint} Paint */

/**
 * @typedef {Object} BarOptions
 * @property {() => void} onPaint
 * @property {(source: CloudSource) => void} onChosen a camera was chosen or left out
 * @property {() => void} onLimit
 * @property {() => void} onReset
 * @property {() => void} onClose
 */

/**
 * What distinguishes a source from the others: its camera, or its stream if the camera has several.
 *
 * @param {CloudSource} source
 * @param {CloudSource[]} sources
 */
function nameOf(source, sources) {
  return sources.filter(({ camera }) => camera === source.camera).length > 1 ? source.id : source.camera;
}

export class CloudBar {
  #cameras = byId("cloud-cameras", HTMLElement);
  #paint = byId("cloud-paint", HTMLSelectElement);
  #limit = byId("cloud-points", HTMLSelectElement);
  #up = byId("cloud-up", HTMLSelectElement);
  #options;

  /** @param {BarOptions} options */
  constructor(options) {
    this.#options = options;
    this.#paint.addEventListener("change", options.onPaint);
    this.#limit.addEventListener("change", options.onLimit);
    this.#up.addEventListener("change", options.onReset);
    byId("cloud-reset", HTMLButtonElement).addEventListener("click", options.onReset);
    byId("cloud-close", HTMLButtonElement).addEventListener("click", options.onClose);
  }

  /** @returns {Paint} */
  get paint() {
    return /** @type {Paint} */ (this.#paint.value);
  }

  /**
   * Goes on to the next colours.
   *
   * @returns {string} their name
   */
  nextPaint() {
    this.#paint.selectedIndex = (this.#paint.selectedIndex + 1) % this.#paint.options.length;
    return this.#paint.selectedOptions[0]?.text ?? "";
  }

  /** Points that are drawn at the most; `null`: as many as this computer draws in time. */
  get limit() {
    return this.#limit.value === "auto" ? null : Number(this.#limit.value);
  }

  /** The axis of the mount that is up; `null`: as the cameras stand. */
  get up() {
    return AXES[this.#up.value] ?? null;
  }

  /** @param {CloudSource[]} sources */
  offer(sources) {
    const labels = sources.map((source) => {
      const label = make("label", "check");
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = source.isShown;
      box.addEventListener("change", () => {
        source.isShown = box.checked;
        this.#options.onChosen(source);
      });
      const swatch = make("span", "swatch");
      swatch.style.background = `rgb(${source.tint.map((part) => Math.round(part * 255)).join(" ")})`;
      const name = document.createElement("span");
      name.textContent = nameOf(source, sources);
      label.append(box, swatch, name);
      return label;
    });
    this.#cameras.replaceChildren(...labels);
  }
}
