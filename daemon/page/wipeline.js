/** The line between raw and refined depth in the enlarged image, to be dragged; its slider is for the keyboard. */

import { make } from "./dom.js";

/** @typedef {import("./tile.js").Tile} Tile */

export class WipeLine {
  #line = make("div", "wipe-line");
  #mixing;
  /** @type {Tile | null} */
  #tile = null;
  #resized = new ResizeObserver(() => this.place());

  /** @param {import("./mixture.js").Mixing} mixing */
  constructor(mixing) {
    this.#mixing = mixing;
    this.#line.setAttribute("aria-hidden", "true");
    mixing.slider.addEventListener("input", () => this.place());
    this.#line.addEventListener("pointerdown", (event) => {
      if (event.button === 0) {
        this.#line.setPointerCapture(event.pointerId);
        // Neither a selection nor the rectangle of a plane begins here.
        event.preventDefault();
        event.stopPropagation();
      }
    });
    this.#line.addEventListener("pointermove", (event) => {
      if (this.#line.hasPointerCapture(event.pointerId)) {
        this.#drag(event.clientX);
      }
    });
  }

  /** @param {Tile | null} tile that is enlarged */
  enlarged(tile) {
    this.#line.remove();
    this.#resized.disconnect();
    this.#tile = tile;
    if (tile !== null) {
      this.#resized.observe(tile.view);
      this.#resized.observe(tile.canvas);
    }
    this.place();
  }

  /** Puts the line where the slider is. */
  place() {
    const tile = this.#tile;
    if (tile === null || !this.#mixing.isPossible) {
      this.#line.remove();
      return;
    }
    if (this.#line.parentElement !== tile.view) {
      tile.view.append(this.#line);
    }
    const { left, top, width, height } = tile.imageRect;
    const { valueAsNumber, max } = this.#mixing.slider;
    this.#line.style.left = `${tile.view.scrollLeft + left + (width * valueAsNumber) / Number(max)}px`;
    this.#line.style.top = `${tile.view.scrollTop + top}px`;
    this.#line.style.height = `${height}px`;
  }

  /** @param {number} clientX */
  #drag(clientX) {
    const tile = this.#tile;
    if (tile === null) {
      return;
    }
    const { slider } = this.#mixing;
    const { left, width } = tile.imageRect;
    const share = (clientX - tile.view.getBoundingClientRect().left - left) / Math.max(1, width);
    slider.valueAsNumber = Math.min(1, Math.max(0, share)) * Number(slider.max);
    slider.dispatchEvent(new Event("input"));
  }
}
