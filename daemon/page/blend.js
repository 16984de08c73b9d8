/** The blend of colour and depth in the enlarged view. */

import { byId } from "./dom.js";

/** @typedef {import("./tile.js").Tile} Tile */

/**
 * The stream of the same camera that the enlarged one can be blended with: of the other kind, and as large, since
 * only then do equal pixels show the same direction.
 *
 * @param {Iterable<Tile>} tiles
 * @param {Tile} enlarged
 * @returns {Tile | null}
 */
export function partnerOf(tiles, enlarged) {
  const fits = [...tiles].filter(
    (tile) =>
      tile.camera === enlarged.camera &&
      tile.isDepth !== enlarged.isDepth &&
      tile.stream.width === enlarged.stream.width &&
      tile.stream.height === enlarged.stream.height,
  );
  return fits.find(({ id }) => id.endsWith("/color")) ?? fits[0] ?? null;
}

export class Blend {
  #slider = byId("blend", HTMLInputElement);
  #box = byId("blend-box", HTMLElement);
  /** @type {Tile | null} */
  #partner = null;

  /** @param {() => void} onChange */
  constructor(onChange) {
    this.#slider.addEventListener("input", onChange);
  }

  /**
   * @param {Iterable<Tile>} tiles
   * @param {Tile | null} enlarged
   */
  enlarged(tiles, enlarged) {
    this.#partner = enlarged === null ? null : partnerOf(tiles, enlarged);
    this.#box.hidden = this.#partner === null;
    this.#slider.value = enlarged?.isDepth ? "100" : "0";
  }

  /**
   * What the enlarged image is made of; `null` while that is its own stream alone.
   *
   * @param {Tile} enlarged
   * @returns {{below: Tile, above: Tile, share: number} | null}
   */
  of(enlarged) {
    const share = this.#slider.valueAsNumber / 100;
    const isOwnAlone = share === (enlarged.isDepth ? 1 : 0);
    if (this.#partner === null || isOwnAlone) {
      return null;
    }
    const below = enlarged.isDepth ? this.#partner : enlarged;
    const above = enlarged.isDepth ? enlarged : this.#partner;
    return { below, above, share };
  }
}
