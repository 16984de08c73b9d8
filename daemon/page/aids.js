/** The panel of aids for setting up a camera, beside its enlarged image. */

import { DepthAids } from "./aidsdepth.js";
import { ImageAids } from "./aidsimage.js";
import { AidsOverlay } from "./aidsoverlay.js";
import { announce, byId, setText } from "./dom.js";

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./types.js").Measure} Measure */
/** @typedef {import("./types.js").Geometry} Geometry */

/**
 * @typedef {Object} AidsOptions
 * @property {() => void} askWatch
 * @property {ReadonlyMap<string, Geometry>} geometries by stream
 */

export class Aids {
  isOpen = false;
  #panel = byId("aids", HTMLElement);
  #button = byId("show-aids", HTMLButtonElement);
  #wall = byId("wall", HTMLElement);
  #stream = byId("aids-stream", HTMLElement);
  #ownSize = byId("aids-own-size", HTMLInputElement);
  #image = new ImageAids(() => this.#paint());
  #depth = new DepthAids(() => this.#planeChanged());
  #overlay = new AidsOverlay();
  /** @type {Tile | null} */
  #tile = null;
  #isDepth = false;
  /** @type {{x: number, y: number} | null} where a rectangle was begun, pixels of the full image */
  #dragFrom = null;
  #options;

  /** @param {AidsOptions} options */
  constructor(options) {
    this.#options = options;
    this.#button.addEventListener("click", () => this.toggle());
    this.#ownSize.addEventListener("change", () => this.#fit());
    this.#wall.addEventListener("pointerdown", (event) => this.#dragBegun(event));
    this.#wall.addEventListener("pointermove", (event) => this.#dragged(event));
    for (const end of /** @type {const} */ (["pointerup", "pointercancel"])) {
      this.#wall.addEventListener(end, () => (this.#dragFrom = null));
    }
  }

  /** For tests and for a look from the console. */
  get facts() {
    const summary = this.#depth.summary;
    return {
      stream: this.isShown ? this.#tile?.id : null,
      measure: this.#image.measure,
      peak: this.#image.peak,
      holes: this.#depth.holes,
      noiseMm: summary?.medianMm ?? null,
      plane: this.#depth.plane,
    };
  }

  /** Whether the numbers of the enlarged stream are needed. */
  get isShown() {
    return this.isOpen && this.#tile !== null;
  }

  toggle() {
    this.isOpen = !this.isOpen;
    this.#button.setAttribute("aria-pressed", String(this.isOpen));
    announce(this.isOpen ? "Aids for setting up" : "Aids closed");
    this.#begin();
    this.#options.askWatch();
  }

  /** @param {Tile | null} tile that is enlarged */
  enlarged(tile) {
    this.#fitOf(this.#tile, false);
    this.#tile = tile;
    this.#button.hidden = tile === null;
    this.#begin();
  }

  #begin() {
    const tile = this.isShown ? this.#tile : null;
    this.#panel.hidden = tile === null;
    this.#wall.classList.toggle("has-aids", tile !== null);
    this.#overlay.attach(tile);
    this.#dragFrom = null;
    this.#isDepth = tile?.isDepth ?? false;
    this.#image.reset(!this.#isDepth);
    this.#depth.reset(this.#isDepth);
    setText(this.#stream, tile?.id ?? "");
    this.#fit();
    this.#paint();
  }

  /** One pixel of the image on one of the screen, or the whole image in the view. */
  #fit() {
    this.#fitOf(this.#tile, this.isShown && this.#ownSize.checked);
  }

  /**
   * @param {Tile | null} tile
   * @param {boolean} isOwnSize
   */
  #fitOf(tile, isOwnSize) {
    if (tile !== null) {
      tile.element.classList.toggle("own-size", isOwnSize);
      tile.view.style.setProperty("--own-width", `${tile.canvas.width / devicePixelRatio}px`);
      tile.view.style.setProperty("--own-height", `${tile.canvas.height / devicePixelRatio}px`);
    }
  }

  /** @param {Tile} tile that shows a new image */
  drawn(tile) {
    if (!this.isShown || tile !== this.#tile || tile.shown === null) {
      return;
    }
    if (tile.isDepth !== this.#isDepth) {
      this.#begin();
    }
    if (tile.isDepth) {
      this.#depth.add(tile.shown.image);
      this.#depth.fit(tile.shown.image, this.#options.geometries.get(tile.id));
    }
    this.#fit();
    this.#paint();
  }

  /** @param {Measure} measure */
  measured(measure) {
    if (!this.isShown || measure.stream !== this.#tile?.id) {
      return;
    }
    if (measure.holes === null) {
      this.#image.measured(measure);
    } else {
      this.#depth.measured(measure.holes);
    }
  }

  #paint() {
    const shown = this.#tile?.shown ?? null;
    if (!this.isShown || shown === null) {
      return;
    }
    const { columns, rows, step } = shown.image;
    if (this.#isDepth) {
      this.#overlay.show(columns, rows, this.#depth.paint, this.#depth.rect(step));
    } else if (shown.bitmap !== null) {
      const { bitmap } = shown;
      this.#overlay.show(columns, rows, this.#image.paint(() => this.#overlay.read(bitmap), columns), null);
    }
  }

  #planeChanged() {
    this.#wall.classList.toggle("has-plane", this.#depth.usesPlane);
    const image = this.#tile?.shown?.image;
    if (this.#isDepth && image?.kind === "depth") {
      this.#depth.keepInside(image);
      this.#depth.fit(image, this.#options.geometries.get(this.#tile?.id ?? ""));
    }
    this.#paint();
  }

  /**
   * The pixel of the full image under the pointer, or the nearest one.
   *
   * @param {PointerEvent} event
   * @returns {{x: number, y: number} | null}
   */
  #pixelUnder(event) {
    const tile = this.#tile;
    if (tile === null) {
      return null;
    }
    const box = tile.view.getBoundingClientRect();
    const rect = tile.imageRect;
    const { columns, rows } = tile.fullSize;
    const within = (/** @type {number} */ value, /** @type {number} */ most) => Math.min(most, Math.max(0, value));
    return {
      x: within(((event.clientX - box.left - rect.left) / rect.width) * columns, columns),
      y: within(((event.clientY - box.top - rect.top) / rect.height) * rows, rows),
    };
  }

  /** @param {PointerEvent} event */
  #dragBegun(event) {
    const isView = event.target instanceof Element && event.target.closest(".enlarged .view") !== null;
    if (this.isShown && this.#isDepth && this.#depth.usesPlane && isView && event.button === 0) {
      this.#dragFrom = this.#pixelUnder(event);
    }
  }

  /** @param {PointerEvent} event */
  #dragged(event) {
    const from = this.#dragFrom;
    const to = from === null ? null : this.#pixelUnder(event);
    const image = this.#tile?.shown?.image;
    if (from === null || to === null || image === undefined) {
      return;
    }
    const rect = {
      left: Math.min(from.x, to.x),
      top: Math.min(from.y, to.y),
      width: Math.abs(to.x - from.x),
      height: Math.abs(to.y - from.y),
    };
    this.#depth.setRect(rect, image);
    this.#planeChanged();
  }
}
