/** What the 3-D view cannot show, and the cure: pure functions. */

import { poseOf } from "./cloudscene.js";

/** @typedef {import("./types.js").Geometry} Geometry */

export const NO_WEBGL =
  "This browser gives the page no WebGL2, which the 3-D view needs. In Chrome or Chromium, switch on “Use graphics " +
  "acceleration when available” in the settings, or start it with --enable-unsafe-swiftshader. The wall works without.";
export const LOST =
  "The graphics driver took the 3-D view away; it comes back by itself. If it does not, close and open it again.";
const SAME_POSES =
  "All cameras have the same pose, so that their points lie within each other. “depthrig calibrate” finds the poses.";

/**
 * @typedef {Object} HintSource
 * @property {string} id
 * @property {string} camera
 * @property {boolean} isShown
 * @property {Geometry | null} geometry
 */

/**
 * @param {HintSource[]} sources of the rig
 * @param {(id: string) => boolean} hasGeometry whether the daemon has said where a stream is
 */
export function cloudHint(sources, hasGeometry) {
  const shown = sources.filter(({ isShown }) => isShown);
  if (shown.length === 0) {
    return sources.length === 0 ? "This rig has no depth stream." : "No camera is chosen.";
  }
  const unplaced = shown.filter(({ id, geometry }) => hasGeometry(id) && geometry === null);
  if (unplaced.length > 0) {
    const names = unplaced.map(({ id }) => id).join(", ");
    return `${names}: the lens is not known, so that its points have no place. Give its intrinsics in the rig file.`;
  }
  const placed = shown.flatMap(({ camera, geometry }) => (geometry === null ? [] : { camera, geometry }));
  const cameras = new Set(placed.map(({ camera }) => camera));
  const poses = new Set(placed.map(({ geometry }) => JSON.stringify(poseOf(geometry))));
  return cameras.size > 1 && poses.size === 1 ? SAME_POSES : "";
}
