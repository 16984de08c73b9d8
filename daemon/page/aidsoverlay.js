/** A layer over the enlarged image, pixel on pixel. */

/** @typedef {import("./plane.js").Rect} Rect */

const RECT_COLORS = /** @type {const} */ (["#000", "#fff"]);

export class AidsOverlay {
  #canvas = document.createElement("canvas");
  #context = /** @type {CanvasRenderingContext2D} */ (this.#canvas.getContext("2d"));
  /** @type {ImageData | null} */
  #pixels = null;
  #copy = document.createElement("canvas");
  #reader = /** @type {CanvasRenderingContext2D} */ (this.#copy.getContext("2d", { willReadFrequently: true }));

  constructor() {
    this.#canvas.className = "overlay";
    this.#canvas.setAttribute("aria-hidden", "true");
  }

  /** @param {import("./tile.js").Tile | null} tile `null`: over nothing */
  attach(tile) {
    this.#canvas.remove();
    this.#canvas.width = 0;
    this.#pixels = null;
    tile?.canvas.after(this.#canvas);
  }

  /**
   * The pixels of a decoded image.
   *
   * @param {ImageBitmap} bitmap
   * @returns {Uint8ClampedArray}
   */
  read(bitmap) {
    if (this.#copy.width !== bitmap.width || this.#copy.height !== bitmap.height) {
      this.#copy.width = bitmap.width;
      this.#copy.height = bitmap.height;
    }
    this.#reader.drawImage(bitmap, 0, 0);
    return this.#reader.getImageData(0, 0, bitmap.width, bitmap.height).data;
  }

  /**
   * Paints the layer anew.
   *
   * @param {number} columns
   * @param {number} rows
   * @param {((overlay: Uint32Array) => void) | null} paint writes into a transparent image; `null`: nothing to write
   * @param {Rect | null} rect pixels of this image
   */
  show(columns, rows, paint, rect) {
    if (this.#canvas.width !== columns || this.#canvas.height !== rows) {
      this.#canvas.width = columns;
      this.#canvas.height = rows;
      this.#pixels = null;
    }
    this.#context.clearRect(0, 0, columns, rows);
    if (paint !== null) {
      this.#pixels ??= this.#context.createImageData(columns, rows);
      const words = new Uint32Array(this.#pixels.data.buffer);
      words.fill(0);
      paint(words);
      this.#context.putImageData(this.#pixels, 0, 0);
    }
    if (rect !== null) {
      // Two lines of which one is seen on every ground.
      RECT_COLORS.forEach((color, i) => {
        this.#context.strokeStyle = color;
        this.#context.lineWidth = 1;
        this.#context.strokeRect(rect.left + i + 0.5, rect.top + i + 0.5, rect.width - 2 * i - 1, rect.height - 2 * i - 1);
      });
    }
  }
}
