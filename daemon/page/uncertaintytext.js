/** The uncertainty of a calibration in words and colours: pure functions. */

/** @typedef {import("./paneltypes.js").CalibratedImage} CalibratedImage */

/** Uncertainty with the strongest colour, pixels, as in the calibration's report. */
export const STRONG_PX = 1;

/**
 * From green to red.
 *
 * @param {number} sigmaPx
 */
export function heat(sigmaPx) {
  const share = Math.min(1, Math.max(0, sigmaPx / STRONG_PX));
  return `hsl(${(130 * (1 - share)).toFixed(0)} 70% 60%)`;
}

/** @param {CalibratedImage} image */
export function uncertaintyText({ stream, uncertainty }) {
  if (uncertainty === null) {
    return `${stream}: the calibration's file has no map of uncertainty. “depthrig calibrate solve” writes one, also from the views that there are.`;
  }
  const { distance_m: distance, pixel_mm: pixel, middle_px: middle, worst_px: worst } = uncertainty;
  const both = (/** @type {number} */ px) => `${px.toFixed(2)} px (${(px * pixel).toFixed(2)} mm)`;
  return (
    `${stream}, uncertainty of projection at ${distance.toFixed(2)} m, one standard deviation: ${both(middle)} in the middle, ` +
    `at most ${both(worst)}; green is none, red is ${STRONG_PX} px and more`
  );
}
