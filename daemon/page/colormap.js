/** Depth as colour: turbo over equal steps of 1/z, near is red, far is blue. Pure functions. */

/** @typedef {{near: number, far: number}} Range metres */

/** Polynomial approximation by A. Mikhailov (Google AI blog, 2019; Apache-2.0), as in tools/src/turbo.rs. */
const RED = [0.13572138, 4.6153926, -42.660323, 132.13108, -152.9424, 59.28638];
const GREEN = [0.09140261, 2.1941884, 4.8429666, -14.185033, 4.2772986, 2.829566];
const BLUE = [0.1066733, 12.641946, -60.582047, 110.36277, -89.90311, 27.34825];

export const DEPTH_VALUES = 65536;

/** Holes: a neutral that turbo has nowhere above `FARTHEST_X`. */
export const HOLE_COLOR = "#26282c";

/** The far end of turbo is nearly black and would look like a hole. */
export const FARTHEST_X = 0.05;

export const NEAREST_M = 0.05;
export const MIN_SPAN_M = 0.05;

const OPAQUE = 0xff000000;

/**
 * @param {number[]} coefficients
 * @param {number} x
 */
function level(coefficients, x) {
  const y = coefficients.reduceRight((sum, k) => sum * x + k, 0);
  return Math.round(Math.min(1, Math.max(0, y)) * 255);
}

/**
 * The colour of `x`: 0 is dark blue, 1 is dark red; values outside are clamped.
 *
 * @param {number} x
 * @returns {[number, number, number]}
 */
export function turbo(x) {
  const inside = Math.min(1, Math.max(0, x));
  return [level(RED, inside), level(GREEN, inside), level(BLUE, inside)];
}

/**
 * One RGBA value for each depth value. 0, a hole, is transparent: what lies below shows through.
 *
 * @param {number} unitM metres of one unit
 * @param {Range} range
 * @returns {Uint32Array}
 */
export function depthTable(unitM, range) {
  const steps = 1024;
  const colors = new Uint32Array(steps + 1);
  for (let i = 0; i <= steps; i++) {
    const [red, green, blue] = turbo(FARTHEST_X + (1 - FARTHEST_X) * (i / steps));
    colors[i] = (OPAQUE | (blue << 16) | (green << 8) | red) >>> 0;
  }
  const table = new Uint32Array(DEPTH_VALUES);
  const inverseFar = 1 / range.far;
  const scale = steps / (1 / range.near - inverseFar);
  for (let value = 1; value < DEPTH_VALUES; value++) {
    const step = Math.round((1 / (value * unitM) - inverseFar) * scale);
    table[value] = colors[Math.min(steps, Math.max(0, step))];
  }
  return table;
}

/**
 * Colours depth values.
 *
 * @param {Uint16Array} depth
 * @param {Uint32Array} table
 * @param {Uint32Array} rgba as long as `depth`
 */
export function colorize(depth, table, rgba) {
  for (let i = 0; i < depth.length; i++) {
    rgba[i] = table[depth[i]];
  }
}

/**
 * A range that is never empty. The end that was not `moved` gives way, unless it has no room left.
 *
 * @param {number} near
 * @param {number} far
 * @param {"near" | "far"} moved
 * @param {number} farthest
 * @returns {Range & {isCorrected: boolean}}
 */
export function validRange(near, far, moved, farthest) {
  const wantedNear = Number.isFinite(near) ? Math.max(NEAREST_M, near) : NEAREST_M;
  const wantedFar = Number.isFinite(far) ? Math.min(farthest, far) : farthest;
  if (wantedFar - wantedNear >= MIN_SPAN_M - 1e-9) {
    return { near: wantedNear, far: wantedFar, isCorrected: wantedNear !== near || wantedFar !== far };
  }
  if (moved === "near") {
    const top = Math.min(wantedNear, farthest - MIN_SPAN_M);
    return { near: top, far: top + MIN_SPAN_M, isCorrected: true };
  }
  const bottom = Math.max(wantedFar, NEAREST_M + MIN_SPAN_M);
  return { near: bottom - MIN_SPAN_M, far: bottom, isCorrected: true };
}

/**
 * Every n-th depth in metres, without holes, so that at most about `limit` are added.
 *
 * @param {Uint16Array} depth
 * @param {number} unitM
 * @param {number} limit
 * @param {number[]} metres is added to
 */
export function sampleDepth(depth, unitM, limit, metres) {
  // An odd stride walks over all columns of the usual even widths.
  const stride = Math.max(1, Math.floor(depth.length / limit)) | 1;
  for (let i = 0; i < depth.length; i += stride) {
    if (depth[i] !== 0) {
      metres.push(depth[i] * unitM);
    }
  }
}

/**
 * The range from the 2nd to the 98th percentile; `null` without depth.
 *
 * @param {number[]} metres is sorted
 * @returns {Range | null}
 */
export function rangeOf(metres) {
  if (metres.length === 0) {
    return null;
  }
  metres.sort((a, b) => a - b);
  const low = metres[Math.floor(0.02 * (metres.length - 1))];
  const high = metres[Math.ceil(0.98 * (metres.length - 1))];
  const near = Math.max(NEAREST_M, low);
  return { near, far: Math.max(high, near + MIN_SPAN_M) };
}
