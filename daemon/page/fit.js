/** Fits the tiles into the wall. */

import { fitTile } from "./layout.js";

const GAP_PX = 8;
const CAPTION_PX = 26;
/** A narrow tile has its numbers below its name (style.css has the same width). */
const NARROW_PX = 300;
const NARROW_CAPTION_PX = 44;

/**
 * @param {HTMLElement} wall
 * @param {HTMLElement} cameras
 * @param {import("./tile.js").Tile[]} tiles
 */
export function fitWall(wall, cameras, tiles) {
  if (tiles.length === 0) {
    return;
  }
  const perCamera = [...cameras.children].map((group) => group.childElementCount);
  const ratios = tiles.map(({ stream }) => stream.height / Math.max(1, stream.width)).sort((a, b) => a - b);
  // All tiles have the shape of most; the images of the others have bars beside them.
  const ratio = ratios[Math.floor(ratios.length / 2)];
  const inner = { width: wall.clientWidth - 2 * GAP_PX, height: wall.clientHeight - 2 * GAP_PX };
  const heightOf = (/** @type {number} */ tile) => tile * ratio + (tile < NARROW_PX ? NARROW_CAPTION_PX : CAPTION_PX);
  wall.style.setProperty("--tile", `${fitTile(perCamera, inner, GAP_PX, heightOf)}px`);
  wall.style.setProperty("--aspect", String(1 / ratio));
}
