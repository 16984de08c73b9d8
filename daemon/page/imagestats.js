/** What an image shows of focus and exposure, pixel by pixel: pure functions. */

/** A Laplacian of luma (4 neighbours, of 255 levels) above this is an edge in focus. */
export const PEAKING_FROM = 32;
/** JPEG moves a white pixel by some levels. */
export const BRIGHT_FROM = 250;
export const DARK_TO = 4;
const STRIPE_PX = 4;

/** As the bytes R G B A of an image lie in a word of a little-endian computer. */
const PEAKING_COLOR = 0xffff40ff;
const BRIGHT_COLOR = 0xff2020ff;
const DARK_COLOR = 0xffff9030;

/**
 * @param {Uint8ClampedArray} rgba
 * @returns {Uint8Array}
 */
export function lumaOf(rgba) {
  const luma = new Uint8Array(rgba.length / 4);
  for (let i = 0; i < luma.length; i++) {
    luma[i] = (77 * rgba[4 * i] + 150 * rgba[4 * i + 1] + 29 * rgba[4 * i + 2] + 128) >> 8;
  }
  return luma;
}

/**
 * Marks edges in focus.
 *
 * @param {Uint8Array} luma
 * @param {number} columns
 * @param {Uint32Array} overlay is written where there are any
 * @returns {number} marked pixels
 */
export function markPeaks(luma, columns, overlay) {
  const rows = luma.length / columns;
  let count = 0;
  for (let y = 1; y < rows - 1; y++) {
    for (let x = 1; x < columns - 1; x++) {
      const i = y * columns + x;
      const laplacian = 4 * luma[i] - luma[i - 1] - luma[i + 1] - luma[i - columns] - luma[i + columns];
      if (Math.abs(laplacian) > PEAKING_FROM) {
        overlay[i] = PEAKING_COLOR;
        count += 1;
      }
    }
  }
  return count;
}

/**
 * Stripes over pixels that are clipped: a channel at its maximum, or black.
 *
 * @param {Uint8ClampedArray} rgba
 * @param {number} columns
 * @param {Uint32Array} overlay is written where there are any
 * @returns {{bright: number, dark: number}} clipped pixels, between the stripes too
 */
export function markClipped(rgba, columns, overlay) {
  const count = { bright: 0, dark: 0 };
  for (let i = 0; i < overlay.length; i++) {
    const most = Math.max(rgba[4 * i], rgba[4 * i + 1], rgba[4 * i + 2]);
    const isBright = most >= BRIGHT_FROM;
    if (!isBright && most > DARK_TO) {
      continue;
    }
    count[isBright ? "bright" : "dark"] += 1;
    const diagonal = (i % columns) + Math.floor(i / columns);
    if (Math.floor(diagonal / STRIPE_PX) % 2 === 0) {
      overlay[i] = isBright ? BRIGHT_COLOR : DARK_COLOR;
    }
  }
  return count;
}

/**
 * Heights of the bars of a histogram, 0 to 1. The root shows small shares beside large ones.
 *
 * @param {number[]} shares
 * @returns {number[]}
 */
export function barHeights(shares) {
  const most = Math.max(...shares, 1e-9);
  return shares.map((share) => Math.sqrt(share / most));
}

/** The highest value since it was reset, to turn a focus ring back to it. */
export class PeakHold {
  peak = 0;

  /**
   * @param {number} value
   * @returns {number} share of the peak, 0 to 1
   */
  follow(value) {
    this.peak = Math.max(this.peak, value);
    return this.peak > 0 ? value / this.peak : 0;
  }

  reset() {
    this.peak = 0;
  }
}
