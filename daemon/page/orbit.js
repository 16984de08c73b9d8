/** The viewpoint of the 3-D view, which turns about a target: pure functions. */

import { add, cross, dot, inversePose, length, lookAt, perspective, rotate, scale, subtract, unit } from "./matrix.js";

/** @typedef {import("./matrix.js").Vector} Vector */
/** @typedef {import("./matrix.js").Matrix} Matrix */

/**
 * @typedef {Object} Orbit
 * @property {Vector} target
 * @property {Vector} up of length 1
 * @property {number} distance metres from the target to the eye
 * @property {number} yaw radians about `up`
 * @property {number} pitch radians above the plane across `up`
 */

export const FOV_Y = (50 * Math.PI) / 180;
/** Straight above, left and right would be undefined. */
const STEEPEST = (89 * Math.PI) / 180;
const NEAREST_M = 0.02;
const FARTHEST_M = 100;
/** A home view looks down a little, so that planes across the line of sight have depth. */
const HOME_PITCH = (24 * Math.PI) / 180;
/** A little from the side, so that the lines of sight have a length. */
const HOME_YAW = (20 * Math.PI) / 180;
const HOME_MARGIN = 0.95;
/** Without depth, cameras are taken to see so far. */
const BLIND_M = 1.5;

/**
 * Two directions across `up`, the same for the same `up`.
 *
 * @param {Vector} up
 * @returns {[Vector, Vector]}
 */
function across(up) {
  const helper = /** @type {Vector} */ (Math.abs(up[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0]);
  const first = unit(subtract(helper, scale(up, dot(helper, up))));
  return [first, cross(up, first)];
}

/**
 * From the target to the eye, of length 1.
 *
 * @param {Orbit} orbit
 * @returns {Vector}
 */
function towardsEye({ up, yaw, pitch }) {
  const [first, second] = across(up);
  const level = add(scale(first, Math.cos(yaw)), scale(second, Math.sin(yaw)));
  return add(scale(level, Math.cos(pitch)), scale(up, Math.sin(pitch)));
}

/**
 * @param {Orbit} orbit
 * @returns {Vector}
 */
export function eyeOf(orbit) {
  return add(orbit.target, scale(towardsEye(orbit), orbit.distance));
}

/**
 * @param {Orbit} orbit
 * @returns {Matrix}
 */
export function viewMatrix(orbit) {
  return lookAt(eyeOf(orbit), orbit.target, orbit.up);
}

/**
 * @param {Orbit} orbit
 * @param {number} aspect
 * @returns {Matrix}
 */
export function projectionMatrix(orbit, aspect) {
  const near = Math.max(0.01, orbit.distance / 100);
  return perspective(FOV_Y, aspect, near, orbit.distance + 60);
}

/**
 * @param {Orbit} orbit
 * @param {number} yaw radians
 * @param {number} pitch radians
 * @returns {Orbit}
 */
export function turned(orbit, yaw, pitch) {
  const steep = Math.min(STEEPEST, Math.max(-STEEPEST, orbit.pitch + pitch));
  return { ...orbit, yaw: (orbit.yaw + yaw) % (2 * Math.PI), pitch: steep };
}

/**
 * Moves the scene with the pointer.
 *
 * @param {Orbit} orbit
 * @param {number} right share of the view's height
 * @param {number} down share of the view's height
 * @returns {Orbit}
 */
export function panned(orbit, right, down) {
  const metres = 2 * orbit.distance * Math.tan(FOV_Y / 2);
  const toWorld = inversePose(viewMatrix(orbit));
  const moved = rotate(toWorld, [-right * metres, down * metres, 0]);
  return { ...orbit, target: add(orbit.target, moved) };
}

/**
 * @param {Orbit} orbit
 * @param {number} factor of the distance
 * @returns {Orbit}
 */
export function zoomed(orbit, factor) {
  return { ...orbit, distance: Math.min(FARTHEST_M, Math.max(NEAREST_M, orbit.distance * factor)) };
}

/**
 * The view from behind the cameras, or from beside them when they look at each other, with most points in it.
 *
 * @param {Matrix[]} poses of the cameras, at least one
 * @param {Vector[]} points that they see
 * @param {Vector} up
 * @returns {Orbit}
 */
export function home(poses, points, up) {
  const seen = points.length > 0 ? points : poses.map((pose) => ahead(pose, BLIND_M));
  const target = /** @type {Vector} */ ([0, 1, 2].map((i) => quantile(seen.map((point) => point[i]), 0.5)));
  /** @type {Vector} */
  let forward = [0, 0, 0];
  for (const pose of poses) {
    forward = add(forward, scale(rotate(pose, [0, 0, 1]), 1 / poses.length));
  }
  const away = (/** @type {Vector} */ point) => length(subtract(point, target));
  const reach = quantile(seen.map(away), 0.9);
  // The cameras are in it too, unless what they see is far smaller than its distance.
  const toCameras = Math.min(4 * reach, Math.max(...poses.map((pose) => away(ahead(pose, 0)))));
  const distance = Math.max(0.3, (HOME_MARGIN * Math.max(reach, toCameras)) / Math.tan(FOV_Y / 2));
  const [first, second] = across(up);
  const level = subtract(forward, scale(up, dot(forward, up)));
  const isCommon = length(level) > 0.3;
  const yaw = isCommon ? Math.atan2(-dot(level, second), -dot(level, first)) + HOME_YAW : 0;
  return { target, up, distance, yaw, pitch: HOME_PITCH };
}

/**
 * A point on the optical axis.
 *
 * @param {Matrix} pose
 * @param {number} metres
 * @returns {Vector}
 */
function ahead(pose, metres) {
  return add([pose[12], pose[13], pose[14]], scale(rotate(pose, [0, 0, 1]), metres));
}

/**
 * The value below which this share of the values lies.
 *
 * @param {number[]} values at least one
 * @param {number} share
 */
export function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.round(share * (sorted.length - 1))];
}
