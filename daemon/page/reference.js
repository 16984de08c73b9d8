/** A reference image over the enlarged live one, and how far the camera has moved since. */

import { announce, byId, make, makeButton, makeText, setState, setText } from "./dom.js";
import { lumaOf } from "./imagestats.js";
import { shiftState, shiftText } from "./referencetext.js";
import { ShiftMeter } from "./shift.js";

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./shift.js").Shift} Shift */

/**
 * @typedef {Object} Kept the reference of a stream
 * @property {ImageBitmap} image
 * @property {ShiftMeter} meter
 * @property {number} fullColumns
 * @property {number} fullRows
 * @property {number} at when it was taken, ms since 1970
 */

const KEY = "depthrig-reference:";
const LARGEST_WIDTH = 960;
const QUALITY = 0.85;
const EVERY_MS = 1000;
const JPEG = "data:image/jpeg;base64,";

export class Reference {
  #isOpen = false;
  #button = byId("show-reference", HTMLButtonElement);
  #box = byId("reference", HTMLElement);
  #title = makeText("span", "", "");
  #shiftLine = makeText("strong", "", "");
  #how = document.createElement("select");
  #overlay = document.createElement("canvas");
  /** Images as large as a reference, to be read. */
  #copy = document.createElement("canvas");
  #reader = /** @type {CanvasRenderingContext2D} */ (this.#copy.getContext("2d", { willReadFrequently: true }));
  /** @type {Tile | null} */
  #tile = null;
  /** @type {Map<string, Kept>} by stream */
  #kept = new Map();
  /** @type {Shift | null} of the full image */
  #shift = null;
  #measuredAt = -Infinity;

  constructor() {
    for (const [value, text] of [["half", "half transparent"], ["difference", "difference"]]) {
      const option = makeText("option", "", text);
      option.value = value;
      this.#how.append(option);
    }
    this.#how.setAttribute("aria-label", "How the reference is shown");
    this.#how.addEventListener("change", () => this.#show());
    this.#overlay.setAttribute("aria-hidden", "true");
    const line = make("div", "row");
    line.append(this.#title, makeButton("Keep the present image", () => void this.#keep()), this.#how);
    this.#box.append(line, this.#shiftLine);
  }

  /** For tests and for a look from the console. */
  get facts() {
    const kept = this.#kept.get(this.#tile?.id ?? "");
    return { stream: this.#isOpen ? this.#tile?.id : null, at: kept?.at ?? null, shift: this.#shift };
  }

  /** Shows the reference of the enlarged stream, or hides it. Without one the present image becomes it. */
  toggle() {
    this.#isOpen = !this.#isOpen;
    this.#button.setAttribute("aria-pressed", String(this.#isOpen));
    announce(this.#isOpen ? "Reference" : "Reference closed");
    this.#show();
    if (this.#isOpen) {
      void this.#open();
    }
  }

  async #open() {
    const tile = this.#tile;
    if (tile !== null && !this.#kept.has(tile.id) && !(await this.#load(tile.id))) {
      await this.#keep();
    }
    this.#show();
  }

  /** @param {Tile | null} tile that is enlarged */
  enlarged(tile) {
    const shown = tile?.isDepth ? null : tile;
    if (shown === this.#tile) {
      return;
    }
    this.#tile = shown;
    this.#shift = null;
    this.#show();
    if (shown !== null && this.#isOpen && !this.#kept.has(shown.id)) {
      void this.#load(shown.id).then(() => this.#show());
    }
  }

  /** @param {Tile} tile that shows a new image */
  drawn(tile) {
    const now = performance.now();
    if (this.#isOpen && tile === this.#tile && now - this.#measuredAt >= EVERY_MS) {
      this.#measuredAt = now;
      this.#measure();
    }
  }

  /** The reference of the enlarged stream, if it has the size of its images. */
  get #present() {
    const kept = this.#kept.get(this.#tile?.id ?? "");
    const size = this.#tile?.fullSize;
    return kept !== undefined && kept.fullColumns === size?.columns && kept.fullRows === size.rows ? kept : null;
  }

  /**
   * An image, as large as its reference is kept.
   *
   * @param {CanvasImageSource} image
   * @param {number} columns
   * @param {number} rows
   * @returns {import("./shift.js").Luma}
   */
  #read(image, columns, rows) {
    this.#copy.width = columns;
    this.#copy.height = rows;
    this.#reader.drawImage(image, 0, 0, columns, rows);
    return { luma: lumaOf(this.#reader.getImageData(0, 0, columns, rows).data), columns, rows };
  }

  /** Makes the present image the reference. */
  async #keep() {
    const tile = this.#tile;
    const bitmap = tile?.shown?.bitmap;
    if (tile === null || !bitmap) {
      setText(this.#shiftLine, "No image to keep has come yet");
      return;
    }
    const { columns: fullColumns, rows: fullRows } = tile.fullSize;
    const columns = Math.min(fullColumns, LARGEST_WIDTH);
    const rows = Math.max(1, Math.round((fullRows * columns) / fullColumns));
    const luma = this.#read(bitmap, columns, rows);
    const text = this.#copy.toDataURL("image/jpeg", QUALITY).slice(JPEG.length);
    const at = Date.now();
    try {
      sessionStorage.setItem(KEY + tile.id, JSON.stringify({ fullColumns, fullRows, at, text }));
    } catch {
      // Without room it lasts until the page is loaded again.
    }
    this.#shift = null;
    this.#kept.set(tile.id, { image: await createImageBitmap(this.#copy), meter: new ShiftMeter(luma), fullColumns, fullRows, at });
    announce("The present image is the reference");
    this.#show();
  }

  /**
   * Takes the reference of a stream from before a reload.
   *
   * @param {string} stream
   * @returns {Promise<boolean>} whether there is one
   */
  async #load(stream) {
    try {
      /** @type {{fullColumns: number, fullRows: number, at: number, text: string}} */
      const { fullColumns, fullRows, at, text } = JSON.parse(sessionStorage.getItem(KEY + stream) ?? "null");
      const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
      const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
      const meter = new ShiftMeter(this.#read(image, image.width, image.height));
      this.#kept.set(stream, { image, meter, fullColumns, fullRows, at });
      return true;
    } catch {
      return false;
    }
  }

  #measure() {
    const kept = this.#present;
    const bitmap = this.#tile?.shown?.bitmap;
    if (kept !== null && bitmap) {
      const { width, height } = kept.image;
      const found = kept.meter.measure(this.#read(bitmap, width, height));
      const scale = kept.fullColumns / width;
      this.#shift = { ...found, dx: found.dx * scale, dy: found.dy * scale };
    }
    this.#say();
  }

  #say() {
    const kept = this.#kept.get(this.#tile?.id ?? "");
    setText(this.#title, kept === undefined ? "No reference" : `Reference of ${new Date(kept.at).toLocaleTimeString()}`);
    if (kept === undefined) {
      setText(this.#shiftLine, "");
    } else if (this.#present === null) {
      setText(this.#shiftLine, `The reference has ${kept.fullColumns}x${kept.fullRows} pixels, the images have others: keep a new one`);
    } else {
      setText(this.#shiftLine, shiftText(this.#shift));
    }
    setState(this.#shiftLine, this.#present === null ? "unknown" : shiftState(this.#shift));
  }

  #show() {
    const isShown = this.#isOpen && this.#tile !== null;
    this.#box.hidden = !isShown;
    this.#overlay.remove();
    const kept = this.#present;
    if (isShown && kept !== null) {
      this.#overlay.className = `overlay reference ${this.#how.value}`;
      this.#overlay.width = kept.image.width;
      this.#overlay.height = kept.image.height;
      this.#overlay.getContext("2d")?.drawImage(kept.image, 0, 0);
      this.#tile?.canvas.after(this.#overlay);
    }
    this.#say();
  }
}
