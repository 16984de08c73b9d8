/** How uncertain the calibration is over an image, as its report draws it. */

import { make, makeText } from "./dom.js";
import { heat, uncertaintyText } from "./uncertaintytext.js";

/** @typedef {import("./paneltypes.js").CalibratedImage} CalibratedImage */

const WIDTH = 300;
/** Where the lens shows nothing. */
const NOTHING_COLOR = "#888";

/**
 * The map of a stream with its numbers in words; without a map, why there is none.
 *
 * @param {CalibratedImage} image
 * @returns {HTMLElement}
 */
export function uncertaintyMap(image) {
  const text = uncertaintyText(image);
  if (image.uncertainty === null) {
    return makeText("p", "quiet", text);
  }
  const { columns, sigma_px: sigma } = image.uncertainty;
  const figure = make("figure", "uncertainty");
  const canvas = document.createElement("canvas");
  canvas.width = WIDTH;
  canvas.height = Math.round((WIDTH * image.height) / image.width);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", text);
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const rows = sigma.length / columns;
  sigma.forEach((value, i) => {
    // Whole pixels: neighbours leave no seam.
    const left = Math.round(((i % columns) * canvas.width) / columns);
    const right = Math.round((((i % columns) + 1) * canvas.width) / columns);
    const row = Math.floor(i / columns);
    const top = Math.round((row * canvas.height) / rows);
    const bottom = Math.round(((row + 1) * canvas.height) / rows);
    context.fillStyle = value === null ? NOTHING_COLOR : heat(value);
    context.fillRect(left, top, right - left, bottom - top);
  });
  figure.append(canvas, makeText("figcaption", "quiet", text));
  return figure;
}
