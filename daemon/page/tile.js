/** One image stream on the wall: its element, its newest image, and what is said about it. */

import { HOLE_COLOR, colorize } from "./colormap.js";
import { make, setState, setText } from "./dom.js";
import { imageRect, pointOver } from "./layout.js";
import { depthOf } from "./protocol.js";
import { ImageSlot } from "./slot.js";

/** @typedef {import("./slot.js").Prepared} Prepared */
/** @typedef {(unitM: number) => Uint32Array} Tables colour table for a unit of depth */

const DEPTH_FORMATS = ["z16", "depth_f32"];

/** @param {string} format */
export function isDepthFormat(format) {
  return DEPTH_FORMATS.includes(format);
}

export class Tile {
  element = make("section", "tile");
  canvas = document.createElement("canvas");
  view = make("div", "view");
  #name = make("span", "name");
  #numbers = make("span", "numbers");
  #message = make("p", "message");
  #context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));

  #slot;
  /** @type {Prepared | null} on the canvas */
  shown = null;
  /** @type {HTMLCanvasElement | null} coloured depth with transparent holes */
  #depthLayer = null;
  /** @type {ImageData | null} */
  #pixels = null;

  isOnScreen = false;
  /** When it was asked for, or came onto the screen; ms as of `performance.now()`. */
  watchedSince = 0;
  drawnAt = -Infinity;

  /**
   * @param {import("./types.js").StreamStatus} stream
   * @param {string} camera
   * @param {() => void} onPrepared an image waits to be drawn
   */
  constructor(stream, camera, onPrepared) {
    this.stream = stream;
    this.id = stream.id;
    this.camera = camera;
    this.isDepth = isDepthFormat(stream.format);
    this.#slot = new ImageSlot(onPrepared);
    this.element.dataset.stream = stream.id;
    this.element.dataset.camera = camera;
    this.element.dataset.state = "waiting";
    this.element.tabIndex = 0;
    this.element.setAttribute("aria-label", `${stream.id}: Enter enlarges`);
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `Image of ${stream.id}`);
    this.#name.textContent = stream.id;
    this.#name.title = stream.id;
    const caption = make("div", "caption");
    caption.append(this.#name, this.#numbers);
    this.view.append(this.canvas, this.#message);
    this.element.append(this.view, caption);
  }

  /** @param {import("./slot.js").Delivery} delivery */
  accept(delivery) {
    this.#slot.put(delivery);
  }

  dropUndrawn() {
    this.#slot.clear();
  }

  /**
   * Makes the newest image the one that is shown.
   *
   * @returns {Prepared | null} `null` without a new one
   */
  takeNewest() {
    const prepared = this.#slot.take();
    if (prepared !== null) {
      this.shown?.bitmap?.close();
      this.shown = prepared;
      this.isDepth = prepared.image.kind === "depth";
      this.drawnAt = performance.now();
    }
    return prepared;
  }

  /**
   * The shown image as something to draw; depth with transparent holes.
   *
   * @param {Tables} tables
   * @returns {CanvasImageSource | null}
   */
  layer(tables) {
    const shown = this.shown;
    if (shown === null || shown.image.kind === "jpeg") {
      return shown?.bitmap ?? null;
    }
    const { columns, rows, unitM } = shown.image;
    const layer = (this.#depthLayer ??= document.createElement("canvas"));
    const context = /** @type {CanvasRenderingContext2D} */ (layer.getContext("2d"));
    if (this.#pixels === null || layer.width !== columns || layer.height !== rows) {
      layer.width = columns;
      layer.height = rows;
      this.#pixels = context.createImageData(columns, rows);
    }
    colorize(depthOf(shown.image), tables(unitM), new Uint32Array(this.#pixels.data.buffer));
    context.putImageData(this.#pixels, 0, 0);
    return layer;
  }

  /**
   * Draws the shown image, or a mixture of two of the same scene.
   *
   * @param {Tables} tables
   * @param {import("./mixture.js").Mixture | null} mixture
   */
  draw(tables, mixture) {
    if (this.shown === null) {
      return;
    }
    const { columns, rows } = this.shown.image;
    if (this.canvas.width !== columns || this.canvas.height !== rows) {
      this.canvas.width = columns;
      this.canvas.height = rows;
    }
    this.#context.globalAlpha = 1;
    this.#context.fillStyle = HOLE_COLOR;
    this.#context.fillRect(0, 0, columns, rows);
    if (mixture === null) {
      this.#paint(this.layer(tables), 1);
      return;
    }
    const { below, above, share, isWipe } = mixture;
    if (share < 1) {
      this.#paint(below.layer(tables), 1);
    }
    if (isWipe) {
      this.#paintLeft(above.layer(tables), share * columns);
    } else {
      this.#paint(above.layer(tables), share);
    }
  }

  /**
   * Paints the left part; where it has holes, nothing shows through.
   *
   * @param {CanvasImageSource | null} layer
   * @param {number} columns
   */
  #paintLeft(layer, columns) {
    const { height } = this.canvas;
    this.#context.save();
    this.#context.beginPath();
    this.#context.rect(0, 0, columns, height);
    this.#context.clip();
    this.#context.globalAlpha = 1;
    this.#context.fillRect(0, 0, columns, height);
    this.#paint(layer, 1);
    this.#context.restore();
  }

  /**
   * @param {CanvasImageSource | null} layer
   * @param {number} alpha
   */
  #paint(layer, alpha) {
    if (layer !== null && alpha > 0) {
      this.#context.globalAlpha = alpha;
      this.#context.drawImage(layer, 0, 0, this.canvas.width, this.canvas.height);
    }
  }

  /**
   * @param {"live" | "stale" | "waiting" | "failed"} state
   * @param {string} message
   * @param {string | null} numbers `null`: as they are
   */
  say(state, message, numbers) {
    setState(this.element, state);
    setText(this.#message, message);
    this.#message.title = message;
    if (numbers !== null) {
      setText(this.#numbers, numbers);
    }
  }

  /** Columns and rows of the full image. */
  get fullSize() {
    const image = this.shown?.image;
    return { columns: image?.fullColumns ?? this.stream.width, rows: image?.fullRows ?? this.stream.height };
  }

  /** Where the image lies in the view. */
  get imageRect() {
    if (this.element.classList.contains("own-size")) {
      const { offsetLeft, offsetTop, offsetWidth, offsetHeight } = this.canvas;
      const { scrollLeft, scrollTop } = this.view;
      return { left: offsetLeft - scrollLeft, top: offsetTop - scrollTop, width: offsetWidth, height: offsetHeight };
    }
    const box = { width: this.view.clientWidth, height: this.view.clientHeight };
    return imageRect(box, this.fullSize.columns, this.fullSize.rows);
  }

  /**
   * Marks these pixels of the full image, and no others.
   *
   * @param {import("./layout.js").Point[]} pixels
   */
  mark(pixels) {
    for (const old of this.view.querySelectorAll(".mark")) {
      old.remove();
    }
    for (const pixel of pixels) {
      const mark = make("span", "mark");
      const point = pointOver(pixel, this.imageRect, this.fullSize.columns, this.fullSize.rows);
      mark.style.left = `${point.x + this.view.scrollLeft}px`;
      mark.style.top = `${point.y + this.view.scrollTop}px`;
      this.view.append(mark);
    }
  }
}

/**
 * The tile of a camera whose streams are not known: it says why.
 *
 * @param {string} camera
 * @returns {Tile}
 */
export function tileWithoutStream(camera) {
  const stream = { id: camera, format: "", width: 4, height: 3, nominal_hz: 0, rate_hz: 0, dropped: {}, last_frame_age_ms: null };
  const tile = new Tile(stream, camera, () => {});
  // There is nothing to enlarge.
  delete tile.element.dataset.stream;
  tile.element.removeAttribute("tabindex");
  tile.element.setAttribute("aria-label", camera);
  tile.canvas.remove();
  return tile;
}
