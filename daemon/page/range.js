/** The range of the depth colours: sliders, automatic, and the tables that follow from it. */

import { depthTable, rangeOf, sampleDepth, validRange } from "./colormap.js";
import { byId, setText } from "./dom.js";
import { depthOf } from "./protocol.js";

/** @typedef {import("./colormap.js").Range} Range */

const AUTO_EVERY_MS = 500;
const SAMPLES_PER_TILE = 1500;
/** A range that follows each flicker of the 2nd percentile makes the colours swim. */
const AUTO_DEADBAND = 0.05;
const SLIDER_FARTHEST_M = 10;
const FARTHEST_M = 65;
const NOTE_MS = 8000;

export class DepthRange {
  #near = byId("near", HTMLInputElement);
  #far = byId("far", HTMLInputElement);
  #auto = byId("auto-range", HTMLInputElement);
  #nearText = byId("near-text", HTMLElement);
  #farText = byId("far-text", HTMLElement);
  #note = byId("range-note", HTMLElement);
  /** @type {Range} */
  #range = { near: 0.3, far: 4 };
  /** @type {Map<number, Uint32Array>} by unit */
  #tables = new Map();
  #autoAt = -Infinity;
  #noteTimer = 0;
  #onChange;

  /** @param {() => void} onChange the depth on the screen is to be drawn again */
  constructor(onChange) {
    this.#onChange = onChange;
    this.#near.addEventListener("input", () => this.#slid("near"));
    this.#far.addEventListener("input", () => this.#slid("far"));
    this.#auto.addEventListener("change", () => {
      this.#autoAt = -Infinity;
      this.#onChange();
    });
    this.#show();
  }

  /** @type {import("./tile.js").Tables} */
  tables = (unitM) => {
    let table = this.#tables.get(unitM);
    if (table === undefined) {
      table = depthTable(unitM, this.#range);
      this.#tables.set(unitM, table);
    }
    return table;
  };

  get current() {
    return { range: this.#range, isAutomatic: this.#auto.checked };
  }

  /**
   * Follows what is shown, if automatic.
   *
   * @param {Iterable<{shown: {image: import("./types.js").Image} | null, isOnScreen: boolean}>} tiles
   * @param {number} now ms
   */
  follow(tiles, now) {
    if (!this.#auto.checked || now - this.#autoAt < AUTO_EVERY_MS) {
      return;
    }
    this.#autoAt = now;
    /** @type {number[]} */
    const metres = [];
    for (const tile of tiles) {
      const image = tile.shown?.image;
      if (image?.kind === "depth" && tile.isOnScreen) {
        sampleDepth(depthOf(image), image.unitM, SAMPLES_PER_TILE, metres);
      }
    }
    const range = rangeOf(metres);
    if (range !== null && this.#differs(range)) {
      this.#set(range);
    }
  }

  /** @param {Range} range */
  #differs(range) {
    const nearMoved = Math.abs(range.near - this.#range.near) / this.#range.near;
    const farMoved = Math.abs(range.far - this.#range.far) / this.#range.far;
    return Math.max(nearMoved, farMoved) > AUTO_DEADBAND;
  }

  /** @param {"near" | "far"} moved */
  #slid(moved) {
    this.#auto.checked = false;
    const wanted = { near: this.#near.valueAsNumber, far: this.#far.valueAsNumber };
    const range = validRange(wanted.near, wanted.far, moved, Number(this.#far.max));
    const ends = `${range.near.toFixed(2)} m and ${range.far.toFixed(2)} m`;
    this.#say(range.isCorrected ? `Near must lie below far; they are now ${ends}.` : "");
    this.#set(range);
  }

  /** @param {string} text */
  #say(text) {
    clearTimeout(this.#noteTimer);
    setText(this.#note, text);
    this.#noteTimer = setTimeout(() => setText(this.#note, ""), NOTE_MS);
  }

  /** @param {Range} range */
  #set(range) {
    this.#range = { near: range.near, far: Math.min(range.far, FARTHEST_M) };
    this.#tables.clear();
    this.#show();
    this.#onChange();
  }

  #show() {
    const farthest = Math.max(SLIDER_FARTHEST_M, Math.ceil(this.#range.far));
    this.#near.max = String(farthest);
    this.#far.max = String(farthest);
    this.#near.value = String(this.#range.near);
    this.#far.value = String(this.#range.far);
    setText(this.#nearText, `${this.#range.near.toFixed(2)} m`);
    setText(this.#farText, `${this.#range.far.toFixed(2)} m`);
  }
}
