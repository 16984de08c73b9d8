/** Camera models: from a point to a pixel and back, as calib/src/camera/lens.rs defines them. Pure functions. */

/** @typedef {import("./types.js").Intrinsics} Intrinsics */

/** The codes of the models in the shader (cloudshaders.js). */
export const MODEL_CODES = /** @type {Record<string, number>} */ ({
  none: 0,
  brown_conrady: 1,
  rational: 1,
  inverse_brown_conrady: 2,
  kannala_brandt4: 3,
});

/** A ray of a pixel that no point is seen at. */
export const NO_RAY = 1e9;

const MAX_STEPS = 30;
const TOLERANCE_PX = 1e-6;
const DIFFERENCE = 1e-6;
/** Beyond this, about 84 degrees off the axis, no camera of a rig sees. */
const WIDEST_RADIUS = 10;
const RADIUS_STEP = 0.01;

/**
 * Whether the lens is known and this page can compute it.
 *
 * @param {Intrinsics} intrinsics
 */
export function isKnown(intrinsics) {
  return intrinsics.fx > 0 && intrinsics.fy > 0 && intrinsics.model in MODEL_CODES;
}

/**
 * Eight coefficients in OpenCV's order; those that the model does not have are 0.
 *
 * @param {Intrinsics} intrinsics
 * @returns {number[]}
 */
export function coefficients({ model, coeffs }) {
  const counts = /** @type {Record<string, number>} */ ({ none: 0, kannala_brandt4: 4, rational: 8 });
  const count = counts[model] ?? 5;
  return Array.from({ length: 8 }, (_, i) => (i < count ? (coeffs[i] ?? 0) : 0));
}

/**
 * Where the lens shows the point (x, y, 1).
 *
 * @param {number} code of the model
 * @param {number[]} k eight coefficients
 * @param {number} x
 * @param {number} y
 * @returns {[number, number]}
 */
function distort(code, k, x, y) {
  const r2 = x * x + y * y;
  if (code === 0) {
    return [x, y];
  }
  if (code === 3) {
    const r = Math.sqrt(r2);
    const theta = Math.atan(r);
    const t2 = theta * theta;
    const bent = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    const s = r > 1e-8 ? bent / r : 1;
    return [x * s, y * s];
  }
  const top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
  const s = top / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
  // The inverse model has the scaled point in the tangential part, but the unscaled r².
  const [tx, ty] = code === 2 ? [x * s, y * s] : [x, y];
  return [
    x * s + 2 * k[2] * tx * ty + k[3] * (r2 + 2 * tx * tx),
    y * s + k[2] * (r2 + 2 * ty * ty) + 2 * k[3] * tx * ty,
  ];
}

/**
 * How far from the axis on the plane z = 1 the model is valid: further out it folds back.
 *
 * @param {Intrinsics} intrinsics
 */
export function maxRadius(intrinsics) {
  const code = MODEL_CODES[intrinsics.model] ?? 0;
  const k = coefficients(intrinsics);
  [k[2], k[3]] = code === 3 ? [k[2], k[3]] : [0, 0];
  let before = 0;
  for (let r = RADIUS_STEP; r <= WIDEST_RADIUS; r += RADIUS_STEP) {
    const [shown] = distort(code, k, r, 0);
    if (!(shown > before)) {
      return r - RADIUS_STEP;
    }
    before = shown;
  }
  return WIDEST_RADIUS;
}

/**
 * The pixel that shows a point of the optical frame; `null` behind the camera or beyond the model.
 *
 * @param {Intrinsics} intrinsics
 * @param {import("./matrix.js").Vector} point
 * @returns {[number, number] | null}
 */
export function project(intrinsics, [px, py, pz]) {
  const x = px / pz;
  const y = py / pz;
  if (!(pz > 0) || Math.hypot(x, y) > maxRadius(intrinsics)) {
    return null;
  }
  const [u, v] = distort(MODEL_CODES[intrinsics.model] ?? 0, coefficients(intrinsics), x, y);
  return [intrinsics.fx * u + intrinsics.cx, intrinsics.fy * v + intrinsics.cy];
}

/**
 * Makes the inverse of a lens ready: from a pixel to the point (x, y) on the plane z = 1, `null` where none is seen.
 *
 * @param {Intrinsics} intrinsics
 * @returns {(u: number, v: number) => [number, number] | null}
 */
export function unprojector(intrinsics) {
  const { fx, fy, cx, cy } = intrinsics;
  const code = MODEL_CODES[intrinsics.model] ?? 0;
  const k = coefficients(intrinsics);
  const widest = maxRadius(intrinsics);
  const tolerance = TOLERANCE_PX / Math.max(fx, fy);
  return (u, v) => {
    const shownX = (u - cx) / fx;
    const shownY = (v - cy) / fy;
    return code === 0 ? [shownX, shownY] : invert(code, k, shownX, shownY, widest, tolerance);
  };
}

/**
 * Newton's method from the shown point itself.
 *
 * @param {number} code
 * @param {number[]} k
 * @param {number} shownX
 * @param {number} shownY
 * @param {number} widest
 * @param {number} tolerance
 * @returns {[number, number] | null}
 */
function invert(code, k, shownX, shownY, widest, tolerance) {
  const shown = Math.hypot(shownX, shownY);
  const start = shown > widest ? widest / shown : 1;
  let x = shownX * start * 0.999;
  let y = shownY * start * 0.999;
  for (let step = 0; step < MAX_STEPS; step++) {
    const [u, v] = distort(code, k, x, y);
    const errorX = u - shownX;
    const errorY = v - shownY;
    if (Math.hypot(errorX, errorY) < tolerance) {
      return Math.hypot(x, y) <= widest ? [x, y] : null;
    }
    const [ux, vx] = distort(code, k, x + DIFFERENCE, y);
    const [uy, vy] = distort(code, k, x, y + DIFFERENCE);
    const [a, b, c, d] = [ux - u, uy - u, vx - v, vy - v].map((change) => change / DIFFERENCE);
    const determinant = a * d - b * c;
    if (!(determinant > 0)) {
      return null;
    }
    const stepX = (d * errorX - b * errorY) / determinant;
    const stepY = (a * errorY - c * errorX) / determinant;
    // A long step leaves the valley.
    const damped = 0.5 / Math.max(0.5, Math.hypot(stepX, stepY));
    x -= stepX * damped;
    y -= stepY * damped;
    const r = Math.hypot(x, y);
    if (r > widest) {
      x *= widest / r;
      y *= widest / r;
    }
  }
  return null;
}

/**
 * The rays of an image whose pixel (i, j) is the pixel (i * step, j * step) of the full one: x and y at z = 1, row by
 * row, `NO_RAY` where nothing is seen.
 *
 * @param {Intrinsics} intrinsics of the full image
 * @param {number} columns
 * @param {number} rows
 * @param {number} step
 * @returns {Float32Array<ArrayBuffer>}
 */
export function rayTable(intrinsics, columns, rows, step) {
  const unproject = unprojector(intrinsics);
  const rays = new Float32Array(columns * rows * 2);
  for (let j = 0; j < rows; j++) {
    for (let i = 0; i < columns; i++) {
      const ray = unproject(i * step, j * step);
      rays.set(ray ?? [NO_RAY, NO_RAY], (j * columns + i) * 2);
    }
  }
  return rays;
}
