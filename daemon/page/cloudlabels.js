/** Names of the cameras in the 3-D view. */

import { make, setText } from "./dom.js";
import { transform } from "./matrix.js";

/** @typedef {import("./cloudsource.js").CloudSource} CloudSource */

/** A name below its camera stays in the view. */
const LABEL_PX = 34;

/**
 * Where a point is in the view; `null` if it is behind the eye or out of sight.
 *
 * @param {number[]} viewProjection
 * @param {import("./matrix.js").Vector} point
 * @param {{width: number, height: number}} size
 * @returns {{x: number, y: number} | null}
 */
export function placeOf(viewProjection, point, size) {
  const [x, y, , w] = transform(viewProjection, point);
  if (w <= 0 || Math.abs(x) > w || Math.abs(y) > w) {
    return null;
  }
  return { x: ((x / w + 1) / 2) * size.width, y: ((1 - y / w) / 2) * size.height };
}

export class CloudLabels {
  #box;
  /** @type {Map<string, HTMLElement>} */
  #labels = new Map();

  /** @param {HTMLElement} box */
  constructor(box) {
    this.#box = box;
  }

  /**
   * @param {CloudSource[]} sources with a place
   * @param {number[]} viewProjection
   * @param {{width: number, height: number}} size
   */
  show(sources, viewProjection, size) {
    const ids = new Set(sources.map(({ id }) => id));
    for (const [id, label] of this.#labels) {
      if (!ids.has(id)) {
        label.remove();
        this.#labels.delete(id);
      }
    }
    for (const source of sources) {
      const label = this.#labelOf(source);
      const [x, y, z] = source.geometry?.translation_m ?? [0, 0, 0];
      const place = placeOf(viewProjection, [x, y, z], size);
      label.hidden = place === null;
      label.classList.toggle("is-stale", source.isStale || source.isGone);
      setText(label, source.isStale || source.isGone ? `${source.camera}: no image` : source.camera);
      if (place !== null) {
        label.style.left = `${place.x}px`;
        label.style.top = `${Math.min(place.y, size.height - LABEL_PX)}px`;
      }
    }
  }

  /** @param {CloudSource} source */
  #labelOf(source) {
    let label = this.#labels.get(source.id);
    if (label === undefined) {
      label = make("span", "cloud-label");
      this.#labels.set(source.id, label);
      this.#box.append(label);
    }
    return label;
  }
}
