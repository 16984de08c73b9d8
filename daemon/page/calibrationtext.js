/** A calibration, and a capture for one, in words: pure functions. */

/** @typedef {import("./types.js").MountStatus} MountStatus */
/** @typedef {import("./paneltypes.js").CaptureState} CaptureState */
/** @typedef {import("./paneltypes.js").CameraProgress} CameraProgress */

/** @type {Record<CaptureState, string>} */
const STATES = {
  searching: "No camera sees the board",
  moving: "The board moves",
  hold_still: "Hold still",
  known: "This view was taken already; move the board",
  unusable: "Still, but no calibration could use what is seen",
  taken: "Taken; move the board",
};

/** @param {CaptureState} state */
export function stateText(state) {
  return STATES[state] ?? String(state);
}

/** @param {MountStatus} mount */
export function ageText(mount) {
  const days = mount.age_days;
  if (days === null) {
    return `calibrated ${mount.created}`;
  }
  if (days < 1) {
    return "calibrated today";
  }
  return days < 2 ? "calibrated yesterday" : `calibrated ${Math.floor(days)} days ago`;
}

/** @param {CameraProgress} camera */
export function coverageText(camera) {
  const covered = camera.coverage.filter((corners) => corners > 0).length;
  const parts = [`${camera.views} views`, `${covered} of ${camera.coverage.length} parts of the image`];
  if (camera.worst_px !== null && camera.worst_px !== undefined) {
    parts.push(`projection within ${camera.worst_px.toFixed(2)} px`);
  }
  parts.push(camera.corners > 0 ? `sees ${camera.corners} corners` : "does not see the board");
  return parts.join(" · ");
}
