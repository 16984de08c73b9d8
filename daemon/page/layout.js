/** Where tiles and pixels lie: pure functions. */

/** @typedef {{left: number, top: number, width: number, height: number}} Rect */
/** @typedef {{x: number, y: number}} Point */

/** Below this a tile shows too little; the wall scrolls instead. */
export const MIN_TILE_PX = 200;

/**
 * Rows of the wall when tiles of `tile` pixels flow into it, cameras side by side.
 *
 * @param {number[]} cameras number of tiles of each camera
 * @param {number} tile width of a tile
 * @param {number} width of the wall
 * @param {number} gap between tiles, and between cameras
 */
function wallRows(cameras, tile, width, gap) {
  let rows = 0;
  let used = Infinity;
  for (const tiles of cameras) {
    const perRow = Math.max(1, Math.floor((width + gap) / (tile + gap)));
    const columns = Math.min(tiles, perRow);
    const needed = columns * (tile + gap);
    const isNewRow = used + needed > width + gap || tiles > perRow;
    if (isNewRow) {
      rows += Math.ceil(tiles / perRow);
      used = tiles > perRow ? Infinity : needed;
    } else {
      used += needed;
    }
  }
  return rows;
}

/**
 * The greatest width of a tile with which the whole wall is seen at once. Without one the wall scrolls, and its rows
 * are filled.
 *
 * @param {number[]} cameras number of tiles of each camera
 * @param {{width: number, height: number}} wall
 * @param {number} gap
 * @param {(tile: number) => number} heightOf height of a tile of a width
 * @returns {number}
 */
export function fitTile(cameras, wall, gap, heightOf) {
  const widest = Math.max(MIN_TILE_PX, Math.floor(wall.width));
  const mostRows = wallRows(cameras, MIN_TILE_PX, wall.width, gap);
  let filling = MIN_TILE_PX;
  for (let tile = widest; tile >= MIN_TILE_PX; tile -= 1) {
    const rows = wallRows(cameras, tile, wall.width, gap);
    if (rows * (heightOf(tile) + gap) - gap <= wall.height) {
      return tile;
    }
    if (rows <= mostRows && filling === MIN_TILE_PX) {
      filling = tile;
    }
  }
  return filling;
}

/**
 * Where an image lies in its box: as large as fits, in the middle (`object-fit: contain`).
 *
 * @param {{width: number, height: number}} box
 * @param {number} columns
 * @param {number} rows
 * @returns {Rect}
 */
export function imageRect(box, columns, rows) {
  const scale = Math.min(box.width / columns, box.height / rows);
  const width = columns * scale;
  const height = rows * scale;
  return { left: (box.width - width) / 2, top: (box.height - height) / 2, width, height };
}

/**
 * The pixel of the full image under a point of the box; `null` beside the image.
 *
 * @param {Point} point
 * @param {Rect} rect of the image in the box
 * @param {number} columns
 * @param {number} rows
 * @returns {Point | null}
 */
export function pixelAt(point, rect, columns, rows) {
  const x = Math.floor(((point.x - rect.left) / rect.width) * columns);
  const y = Math.floor(((point.y - rect.top) / rect.height) * rows);
  const isInside = x >= 0 && y >= 0 && x < columns && y < rows;
  return isInside ? { x, y } : null;
}

/**
 * The point of the box over the centre of a pixel of the full image.
 *
 * @param {Point} pixel
 * @param {Rect} rect
 * @param {number} columns
 * @param {number} rows
 * @returns {Point}
 */
export function pointOver(pixel, rect, columns, rows) {
  return {
    x: rect.left + ((pixel.x + 0.5) / columns) * rect.width,
    y: rect.top + ((pixel.y + 0.5) / rows) * rect.height,
  };
}
