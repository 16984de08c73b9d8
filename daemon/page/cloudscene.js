/** What stands in the 3-D view beside the points: up, floor, frusta. Pure functions. */

import { NO_RAY, unprojector } from "./lens.js";
import { add, dot, poseMatrix, rotate, scale, subtract, transform, unit } from "./matrix.js";

/** @typedef {import("./matrix.js").Vector} Vector */
/** @typedef {import("./matrix.js").Matrix} Matrix */
/** @typedef {import("./types.js").Geometry} Geometry */

/** Within 35 degrees of an axis of the mount that axis is meant. */
const SNAP = Math.cos((35 * Math.PI) / 180);
const GRID_CELLS = 10;
const CELLS_M = [0.05, 0.1, 0.2, 0.5, 1, 2, 5];

/** @type {Record<string, Vector>} */
export const AXES = {
  "x": [1, 0, 0], "-x": [-1, 0, 0], "y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1], "-z": [0, 0, -1],
};

/**
 * From a stream's optical frame to the mount.
 *
 * @param {Geometry} geometry
 * @returns {Matrix}
 */
export function poseOf(geometry) {
  return poseMatrix(geometry.rotation_xyzw, geometry.translation_m);
}

/**
 * Up on the mount: where the upper edges of the images are, on the whole.
 *
 * @param {Matrix[]} poses
 * @returns {Vector}
 */
export function upOf(poses) {
  /** @type {Vector} */
  let sum = [0, 0, 0];
  for (const pose of poses) {
    sum = add(sum, rotate(pose, [0, -1, 0]));
  }
  const up = unit(sum);
  const axis = Object.values(AXES).find((candidate) => dot(candidate, up) >= SNAP);
  return axis ?? (dot(up, up) > 0.5 ? up : [0, -1, 0]);
}

/**
 * Edges of what a camera sees up to a distance, and a line that marks the top; pairs of points.
 *
 * @param {import("./types.js").Intrinsics} intrinsics
 * @param {number} width pixels of the full image
 * @param {number} height
 * @param {Matrix} pose
 * @param {number} depthM
 * @returns {number[]} six numbers for each line
 */
export function frustumLines(intrinsics, width, height, pose, depthM) {
  const unproject = unprojector(intrinsics);
  const corners = /** @type {[number, number][]} */ ([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]]);
  const ends = corners.map(([u, v]) => {
    // A corner outside the image circle of a fisheye is drawn as a pinhole would see it.
    const ray = unproject(u, v) ?? [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy];
    return placed(pose, scale([ray[0], ray[1], 1], depthM));
  });
  const origin = placed(pose, [0, 0, 0]);
  const lines = ends.flatMap((end, i) => [...origin, ...end, ...end, ...ends[(i + 1) % 4]]);
  const middle = scale(add(ends[0], ends[1]), 0.5);
  const roof = add(middle, scale(subtract(middle, scale(add(ends[2], ends[3]), 0.5)), 0.15));
  return [...lines, ...ends[0], ...roof, ...ends[1], ...roof];
}

/**
 * @param {Matrix} pose
 * @param {Vector} point
 * @returns {Vector}
 */
function placed(pose, point) {
  const [x, y, z] = transform(pose, point);
  return [x, y, z];
}

/**
 * Lines of the floor about a point, at multiples of a round cell.
 *
 * @param {Vector} up
 * @param {number} height along `up`
 * @param {Vector} about
 * @param {number} reach metres from the middle to the edge
 * @returns {{lines: number[], cellM: number}}
 */
export function floorLines(up, height, about, reach) {
  const cellM = CELLS_M.find((cell) => cell * GRID_CELLS >= reach) ?? CELLS_M[CELLS_M.length - 1];
  const helper = /** @type {Vector} */ (Math.abs(up[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0]);
  const first = unit(subtract(helper, scale(up, dot(helper, up))));
  const second = /** @type {Vector} */ ([
    up[1] * first[2] - up[2] * first[1], up[2] * first[0] - up[0] * first[2], up[0] * first[1] - up[1] * first[0],
  ]);
  const at = (/** @type {number} */ a, /** @type {number} */ b) =>
    add(scale(up, height), add(scale(first, a), scale(second, b)));
  const middleA = Math.round(dot(about, first) / cellM) * cellM;
  const middleB = Math.round(dot(about, second) / cellM) * cellM;
  const half = GRID_CELLS * cellM;
  /** @type {number[]} */
  const lines = [];
  for (let i = -GRID_CELLS; i <= GRID_CELLS; i++) {
    const offset = i * cellM;
    lines.push(...at(middleA + offset, middleB - half), ...at(middleA + offset, middleB + half));
    lines.push(...at(middleA - half, middleB + offset), ...at(middleA + half, middleB + offset));
  }
  return { lines, cellM };
}

/**
 * Some points of a depth image on the mount, evenly spread.
 *
 * @param {Uint16Array} depth
 * @param {Float32Array} rays `rayTable` of the image
 * @param {number} unitM
 * @param {Matrix} pose
 * @param {number} limit
 * @returns {Vector[]}
 */
export function samplePoints(depth, rays, unitM, pose, limit) {
  // An odd stride walks over all columns of the usual even widths.
  const stride = Math.max(1, Math.floor(depth.length / limit)) | 1;
  const samples = [];
  for (let i = 0; i < depth.length; i += stride) {
    if (depth[i] !== 0 && rays[2 * i] !== NO_RAY) {
      const z = depth[i] * unitM;
      samples.push(placed(pose, [rays[2 * i] * z, rays[2 * i + 1] * z, z]));
    }
  }
  return samples;
}
