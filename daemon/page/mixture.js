/**
 * Two streams of a camera in the enlarged view, by a slider: colour and depth blended, or raw and refined depth on the
 * two sides of a line.
 */

import { byId } from "./dom.js";

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {{below: Tile, above: Tile, share: number, isWipe: boolean}} Mixture `share` of what lies above */

const RAW = ["/depth_aligned", "/depth"];
const REFINED = "/depth_refined";
const SAME = 1e-6;

/**
 * The stream of the same camera that the enlarged one can be blended with: of the other kind, and as large, since
 * only then do equal pixels show the same direction.
 *
 * @param {Iterable<Tile>} tiles
 * @param {Tile} enlarged
 * @returns {Tile | null}
 */
export function blendPartnerOf(tiles, enlarged) {
  const fits = [...tiles].filter((tile) => tile.isDepth !== enlarged.isDepth && isAsLarge(tile, enlarged));
  return fits.find(({ id }) => id.endsWith("/color")) ?? fits[0] ?? null;
}

/**
 * Refined depth of raw, and the other way round. Refined depth lies in the view of colour: raw depth only if it is
 * registered to it.
 *
 * @param {Iterable<Tile>} tiles
 * @param {Tile} enlarged
 * @param {ReadonlyMap<string, Geometry>} geometries by stream
 * @returns {Tile | null}
 */
export function wipePartnerOf(tiles, enlarged, geometries) {
  const isRefined = enlarged.id.endsWith(REFINED);
  const wanted = isRefined ? RAW : RAW.some((name) => enlarged.id.endsWith(name)) ? [REFINED] : [];
  const fits = [...tiles].filter(
    (tile) => tile.isDepth && isAsLarge(tile, enlarged) && isOneView(geometries.get(tile.id), geometries.get(enlarged.id)),
  );
  return wanted.map((name) => fits.find(({ id }) => id.endsWith(name))).find((tile) => tile !== undefined) ?? null;
}

/**
 * @param {Tile} tile
 * @param {Tile} enlarged
 */
function isAsLarge(tile, enlarged) {
  const { width, height } = enlarged.stream;
  return tile.camera === enlarged.camera && tile.stream.width === width && tile.stream.height === height;
}

/**
 * Whether equal pixels of both show the same direction from the same place.
 *
 * @param {Geometry | undefined} a
 * @param {Geometry | undefined} b
 */
export function isOneView(a, b) {
  if (a === undefined || b === undefined || a.intrinsics.model !== b.intrinsics.model) {
    return false;
  }
  const numbers = (/** @type {Geometry} */ { intrinsics: k, translation_m: t, rotation_xyzw: r }) => [k.fx, k.fy, k.cx, k.cy, ...k.coeffs, ...t, ...r];
  const others = numbers(b);
  return numbers(a).length === others.length && numbers(a).every((value, i) => Math.abs(value - others[i]) <= SAME * Math.max(1, Math.abs(value)));
}

/**
 * @typedef {Object} MixingOptions
 * @property {string} name of its slider in the page, and of its box with `-box` behind it
 * @property {boolean} isWipe
 * @property {(enlarged: Tile) => Tile | null} partnerOf
 * @property {(tile: Tile) => boolean} isAbove whether the stream is the one whose share the slider has
 * @property {() => void} onChange
 */

export class Mixing {
  slider;
  #box;
  /** @type {Tile | null} */
  #enlarged = null;
  /** @type {Tile | null} */
  #partner = null;
  #options;

  /** @param {MixingOptions} options */
  constructor(options) {
    this.#options = options;
    this.slider = byId(options.name, HTMLInputElement);
    this.#box = byId(`${options.name}-box`, HTMLElement);
    this.slider.addEventListener("input", options.onChange);
  }

  /** Whether the enlarged stream can be mixed. */
  get isPossible() {
    return this.#partner !== null;
  }

  /** @param {Tile | null} tile */
  enlarged(tile) {
    this.#enlarged = tile;
    this.#partner = null;
    this.rest();
    this.look();
  }

  /** Looks for a partner while there is none. */
  look() {
    this.#partner ??= this.#enlarged === null ? null : this.#options.partnerOf(this.#enlarged);
    this.#box.hidden = this.#partner === null;
  }

  /** Shows the enlarged stream alone. */
  rest() {
    this.slider.value = this.#enlarged !== null && this.#options.isAbove(this.#enlarged) ? this.slider.max : this.slider.min;
  }

  /**
   * What the enlarged image is made of; `null` while that is its own stream alone.
   *
   * @param {Tile} enlarged
   * @returns {Mixture | null}
   */
  of(enlarged) {
    const share = this.slider.valueAsNumber / Number(this.slider.max);
    const isAbove = this.#options.isAbove(enlarged);
    if (this.#partner === null || share === (isAbove ? 1 : 0)) {
      return null;
    }
    const [below, above] = isAbove ? [this.#partner, enlarged] : [enlarged, this.#partner];
    return { below, above, share, isWipe: this.#options.isWipe };
  }
}

/**
 * Both ways to mix; while one is used, the other rests.
 *
 * @param {() => Iterable<Tile>} tiles
 * @param {ReadonlyMap<string, Geometry>} geometries
 * @param {() => void} onChange
 */
export function mixings(tiles, geometries, onChange) {
  const blend = new Mixing({
    name: "blend",
    isWipe: false,
    partnerOf: (enlarged) => blendPartnerOf(tiles(), enlarged),
    isAbove: (tile) => tile.isDepth,
    onChange: () => used(wipe),
  });
  const wipe = new Mixing({
    name: "wipe",
    isWipe: true,
    partnerOf: (enlarged) => wipePartnerOf(tiles(), enlarged, geometries),
    isAbove: (tile) => !tile.id.endsWith(REFINED),
    onChange: () => used(blend),
  });
  /** @param {Mixing} other */
  function used(other) {
    other.rest();
    onChange();
  }
  return {
    wipe,
    /** @param {Tile | null} tile */
    enlarged: (tile) => [blend, wipe].forEach((mixing) => mixing.enlarged(tile)),
    look: () => [blend, wipe].forEach((mixing) => mixing.look()),
    /** @param {Tile} enlarged */
    of: (enlarged) => wipe.of(enlarged) ?? blend.of(enlarged),
  };
}
