/** How flat the depth of a flat surface is: pure functions. */

/** @typedef {{left: number, top: number, width: number, height: number}} Rect pixels of the full image */

/**
 * @typedef {Object} Plane
 * @property {number} rmsM distance of the points from the plane
 * @property {number} tiltDeg between the plane and the image: 0 is a wall that is faced squarely
 * @property {number} distanceM along the optical axis
 * @property {number} points
 */

const LEAST_POINTS = 20;
const SWEEPS = 30;

/**
 * The plane with the least squares of the points' distances from it; `null` of too few points, or of a line.
 *
 * @param {Float64Array} points x y z of each, in the optical frame
 * @returns {Plane | null}
 */
export function fitPlane(points) {
  const count = points.length / 3;
  if (count < LEAST_POINTS) {
    return null;
  }
  const mean = [0, 0, 0];
  for (let i = 0; i < points.length; i++) {
    mean[i % 3] += points[i] / count;
  }
  const covariance = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < points.length; i += 3) {
    const away = [points[i] - mean[0], points[i + 1] - mean[1], points[i + 2] - mean[2]];
    for (let a = 0; a < 3; a++) {
      for (let b = 0; b < 3; b++) {
        covariance[a][b] += (away[a] * away[b]) / count;
      }
    }
  }
  const { values, vectors } = eigen(covariance);
  const order = [0, 1, 2].sort((a, b) => values[a] - values[b]);
  if (values[order[1]] <= 1e-4 * values[order[2]]) {
    return null;
  }
  const normal = vectors.map((row) => row[order[0]]);
  const along = Math.abs(normal[2]);
  const distanceM = along < 1e-6 ? mean[2] : (normal[0] * mean[0] + normal[1] * mean[1] + normal[2] * mean[2]) / normal[2];
  return {
    rmsM: Math.sqrt(Math.max(0, values[order[0]])),
    tiltDeg: (Math.acos(Math.min(1, along)) * 180) / Math.PI,
    distanceM,
    points: count,
  };
}

/**
 * Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix, by Jacobi's rotations.
 *
 * @param {number[][]} matrix
 * @returns {{values: number[], vectors: number[][]}}
 */
function eigen(matrix) {
  const a = matrix.map((row) => [...row]);
  const v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < SWEEPS; sweep++) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (a[p][q] !== 0) {
        turn(a, v, p, q);
      }
    }
  }
  return { values: [a[0][0], a[1][1], a[2][2]], vectors: v };
}

/**
 * Turns the plane of two axes so that their covariance is 0.
 *
 * @param {number[][]} a
 * @param {number[][]} v
 * @param {number} p
 * @param {number} q
 */
function turn(a, v, p, q) {
  const theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
  const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.hypot(theta, 1));
  const c = 1 / Math.hypot(t, 1);
  const s = t * c;
  for (let k = 0; k < 3; k++) {
    const kp = a[k][p];
    const kq = a[k][q];
    a[k][p] = c * kp - s * kq;
    a[k][q] = s * kp + c * kq;
  }
  for (let k = 0; k < 3; k++) {
    const pk = a[p][k];
    const qk = a[q][k];
    a[p][k] = c * pk - s * qk;
    a[q][k] = s * pk + c * qk;
    const vp = v[k][p];
    const vq = v[k][q];
    v[k][p] = c * vp - s * vq;
    v[k][q] = s * vp + c * vq;
  }
}

/**
 * The points of a depth image in a rectangle, at most about `limit`, evenly spread, without holes.
 *
 * @param {Uint16Array} depth
 * @param {{columns: number, rows: number, step: number, unitM: number}} image
 * @param {Rect} rect of the full image
 * @param {(u: number, v: number) => [number, number] | null} unproject
 * @param {number} limit
 * @returns {Float64Array}
 */
export function pointsIn(depth, { columns, rows, step, unitM }, rect, unproject, limit) {
  const left = Math.max(0, Math.ceil(rect.left / step));
  const top = Math.max(0, Math.ceil(rect.top / step));
  const right = Math.min(columns, Math.ceil((rect.left + rect.width) / step));
  const bottom = Math.min(rows, Math.ceil((rect.top + rect.height) / step));
  const stride = Math.max(1, Math.ceil(Math.sqrt((Math.max(0, right - left) * Math.max(0, bottom - top)) / limit)));
  /** @type {number[]} */
  const points = [];
  for (let j = top; j < bottom; j += stride) {
    for (let i = left; i < right; i += stride) {
      const z = depth[j * columns + i] * unitM;
      const ray = z > 0 ? unproject(i * step, j * step) : null;
      if (ray !== null) {
        points.push(ray[0] * z, ray[1] * z, z);
      }
    }
  }
  return Float64Array.from(points);
}

/**
 * A rectangle inside the image that is large enough to be fitted.
 *
 * @param {Rect} rect
 * @param {number} columns
 * @param {number} rows
 * @returns {Rect}
 */
export function insideImage(rect, columns, rows) {
  const width = Math.min(columns, Math.max(8, Math.round(rect.width)));
  const height = Math.min(rows, Math.max(8, Math.round(rect.height)));
  return {
    left: Math.min(columns - width, Math.max(0, Math.round(rect.left))),
    top: Math.min(rows - height, Math.max(0, Math.round(rect.top))),
    width,
    height,
  };
}

/**
 * @param {number} columns
 * @param {number} rows
 * @returns {Rect} the middle third
 */
export function middleRect(columns, rows) {
  return insideImage({ left: columns / 3, top: rows / 3, width: columns / 3, height: rows / 3 }, columns, rows);
}
