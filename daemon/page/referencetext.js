/** What is said about the shift of an image against its reference: pure functions. */

/** @typedef {import("./shift.js").Shift} Shift */

/** A camera that moved less stands still, pixels of the full image. */
const STILL_PX = 0.5;

/** @param {Shift | null} shift pixels of the full image; `null`: not yet measured */
export function shiftText(shift) {
  if (shift === null) {
    return "measuring";
  }
  if (shift.certainty === "none") {
    return "No shift found: the images have too little in common";
  }
  const signed = (/** @type {number} */ n) => `${n < 0 ? "−" : "+"}${Math.abs(n).toFixed(1)}`;
  const sure = shift.certainty === "sure" ? "sure" : "not sure";
  return `Shift dx ${signed(shift.dx)}, dy ${signed(shift.dy)} px (${sure})`;
}

/**
 * @param {Shift | null} shift
 * @returns {"still" | "moved" | "unknown"}
 */
export function shiftState(shift) {
  if (shift === null || shift.certainty !== "sure") {
    return "unknown";
  }
  return Math.hypot(shift.dx, shift.dy) < STILL_PX ? "still" : "moved";
}
