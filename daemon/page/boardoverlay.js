/** What a capture of a board sees and still wants, drawn over the images of its cameras. */

import { preferredStream } from "./skew.js";

/** @typedef {import("./paneltypes.js").CaptureEvent} CaptureEvent */
/** @typedef {import("./paneltypes.js").CameraProgress} CameraProgress */
/** @typedef {import("./tile.js").Tile} Tile */

const WIDTH = 640;
const COVERED = "rgb(111 208 140 / 18%)";
const CORNER = "#6fd08c";
const WANTED = "#f2c14e";

export class BoardOverlay {
  /** @type {Map<Tile, HTMLCanvasElement>} */
  #canvases = new Map();
  #tiles;

  /** @param {ReadonlyMap<string, Tile>} tiles */
  constructor(tiles) {
    this.#tiles = tiles;
  }

  /** @param {CaptureEvent} event */
  show(event) {
    const { cameras, hint } = event.progress;
    for (const camera of cameras) {
      const own = [...this.#tiles.values()].filter((tile) => tile.camera === camera.name);
      const id = preferredStream(camera.name, own.map((tile) => tile.id));
      const tile = own.find((one) => one.id === id);
      if (tile !== undefined) {
        const outline = hint?.camera === camera.name ? (hint.outline ?? null) : null;
        draw(this.#canvasOf(tile), camera, outline);
      }
    }
  }

  hide() {
    for (const canvas of this.#canvases.values()) {
      canvas.remove();
    }
    this.#canvases.clear();
  }

  /** @param {Tile} tile */
  #canvasOf(tile) {
    let canvas = this.#canvases.get(tile);
    if (canvas === undefined) {
      canvas = document.createElement("canvas");
      canvas.className = "board";
      canvas.setAttribute("aria-hidden", "true");
      tile.view.append(canvas);
      this.#canvases.set(tile, canvas);
    }
    // It fits into its box as the image does if it has its shape.
    const { columns, rows } = tile.fullSize;
    const height = Math.max(1, Math.round((WIDTH * rows) / Math.max(1, columns)));
    if (canvas.width !== WIDTH || canvas.height !== height) {
      canvas.width = WIDTH;
      canvas.height = height;
    }
    return canvas;
  }
}

/**
 * @param {HTMLCanvasElement} canvas
 * @param {CameraProgress} camera
 * @param {[number, number][] | null} outline
 */
function draw(canvas, camera, outline) {
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const { width, height } = canvas;
  context.clearRect(0, 0, width, height);
  const columns = Math.max(1, camera.coverage_columns);
  const rows = Math.max(1, Math.ceil(camera.coverage.length / columns));
  context.fillStyle = COVERED;
  camera.coverage.forEach((corners, i) => {
    if (corners > 0) {
      const x = ((i % columns) * width) / columns;
      const y = (Math.floor(i / columns) * height) / rows;
      context.fillRect(x + 1, y + 1, width / columns - 2, height / rows - 2);
    }
  });
  context.fillStyle = CORNER;
  for (const [x, y] of camera.at) {
    context.beginPath();
    context.arc(x * width, y * height, 3, 0, 2 * Math.PI);
    context.fill();
  }
  if (outline !== null && outline.length > 0) {
    context.strokeStyle = WANTED;
    context.lineWidth = 3;
    context.setLineDash([10, 6]);
    context.beginPath();
    outline.forEach(([x, y], i) => (i === 0 ? context.moveTo(x * width, y * height) : context.lineTo(x * width, y * height)));
    context.closePath();
    context.stroke();
    context.setLineDash([]);
  }
}
