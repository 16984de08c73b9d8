/** Holes and noise of depth over some images of a still scene: pure functions and a sum of images. */

import { FARTHEST_X, turbo } from "./colormap.js";

export const FRAMES = 30;
/** A pixel that has depth less often says nothing about its noise. */
const LEAST_SHARE = 0.5;
const MEDIAN_SAMPLES = 50_000;
const MM_PER_M = 1000;
/** The noise map ends at a multiple of the median, but not below what a step of depth makes. */
const MAP_MEDIANS = 3;
const LEAST_MAP_MM = 1;
const OPAQUE = 0xff000000;

/** From 90 % filled on depth is good, from 50 % on it is usable. */
const GOOD_FILLED = 0.9;
const FAIR_FILLED = 0.5;

/**
 * @param {number} holes share
 * @returns {"good" | "fair" | "bad"}
 */
export function filledState(holes) {
  const filled = 1 - holes;
  return filled >= GOOD_FILLED ? "good" : filled >= FAIR_FILLED ? "fair" : "bad";
}

/**
 * @typedef {Object} DepthSummary
 * @property {number} frames
 * @property {Float32Array} deviationMm standard deviation of each pixel; NaN where depth is missing too often
 * @property {Float32Array} holes share of the images in which each pixel was a hole
 * @property {number | null} medianMm of the deviations
 */

/** Sums up images by Welford's method, which loses no digits where the mean is large and the noise small. */
export class DepthSum {
  frames = 0;
  #counts;
  #means;
  #squares;

  /** @param {number} pixels */
  constructor(pixels) {
    this.#counts = new Uint8Array(pixels);
    this.#means = new Float32Array(pixels);
    this.#squares = new Float32Array(pixels);
  }

  get isComplete() {
    return this.frames >= FRAMES;
  }

  /** @param {Uint16Array} depth */
  add(depth) {
    this.frames += 1;
    for (let i = 0; i < depth.length; i++) {
      const value = depth[i];
      if (value !== 0) {
        const count = ++this.#counts[i];
        const before = value - this.#means[i];
        this.#means[i] += before / count;
        this.#squares[i] += before * (value - this.#means[i]);
      }
    }
  }

  /**
   * @param {number} unitM
   * @returns {DepthSummary}
   */
  summary(unitM) {
    const deviationMm = new Float32Array(this.#counts.length);
    const holes = new Float32Array(this.#counts.length);
    const least = Math.max(2, LEAST_SHARE * this.frames);
    for (let i = 0; i < deviationMm.length; i++) {
      const count = this.#counts[i];
      holes[i] = 1 - count / Math.max(1, this.frames);
      deviationMm[i] = count >= least ? Math.sqrt(this.#squares[i] / (count - 1)) * unitM * MM_PER_M : NaN;
    }
    return { frames: this.frames, deviationMm, holes, medianMm: medianOf(deviationMm) };
  }
}

/**
 * The median of the numbers among the values; of many, of an even choice of them.
 *
 * @param {Float32Array} values
 * @returns {number | null}
 */
export function medianOf(values) {
  // An odd stride walks over all columns of the usual even widths.
  const stride = values.length > MEDIAN_SAMPLES ? Math.ceil(values.length / MEDIAN_SAMPLES) | 1 : 1;
  /** @type {number[]} */
  const numbers = [];
  for (let i = 0; i < values.length; i += stride) {
    if (!Number.isNaN(values[i])) {
      numbers.push(values[i]);
    }
  }
  const sorted = Float32Array.from(numbers).sort();
  return sorted.length === 0 ? null : sorted[Math.floor((sorted.length - 1) / 2)];
}

/**
 * The upper end of the noise map.
 *
 * @param {DepthSummary} summary
 */
export function noiseEndMm({ medianMm }) {
  return Math.max(LEAST_MAP_MM, MAP_MEDIANS * (medianMm ?? 0));
}

/**
 * Noise as colours: blue is none, red is `endMm` and more, transparent is unknown.
 *
 * @param {Float32Array} deviationMm
 * @param {number} endMm
 * @param {Uint32Array} overlay
 */
export function paintNoise(deviationMm, endMm, overlay) {
  const colors = colorTable();
  for (let i = 0; i < overlay.length; i++) {
    const value = deviationMm[i];
    overlay[i] = Number.isNaN(value) ? 0 : colors[Math.min(255, Math.round((value / endMm) * 255))];
  }
}

/**
 * Holes as colours: transparent is never, blue is seldom, red is always.
 *
 * @param {Float32Array} holes
 * @param {Uint32Array} overlay
 */
export function paintHoles(holes, overlay) {
  const colors = colorTable();
  for (let i = 0; i < overlay.length; i++) {
    overlay[i] = holes[i] === 0 ? 0 : colors[Math.round(holes[i] * 255)];
  }
}

/** @returns {Uint32Array} 256 colours from blue to red */
function colorTable() {
  const colors = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const [red, green, blue] = turbo(FARTHEST_X + (0.95 - FARTHEST_X) * (i / 255));
    colors[i] = (OPAQUE | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return colors;
}
