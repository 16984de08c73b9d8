/** Aids for setting up a colour or infrared camera: focus and exposure. */

import { byId, setText } from "./dom.js";
import { PeakHold, barHeights, lumaOf, markClipped, markPeaks } from "./imagestats.js";

/** @typedef {import("./types.js").Measure} Measure */

const HISTOGRAM_COLOR = "#a9b0ba";
const CLIPPED_COLOR = "#ff8a80";

export class ImageAids {
  #box = byId("aids-image", HTMLElement);
  #sharpness = byId("aids-sharpness", HTMLElement);
  #focus = byId("aids-focus", HTMLMeterElement);
  #peaking = byId("aids-peaking", HTMLInputElement);
  #zebra = byId("aids-zebra", HTMLInputElement);
  #clipped = byId("aids-clipped", HTMLElement);
  #histogram = byId("aids-histogram", HTMLCanvasElement);
  #hold = new PeakHold();
  /** @type {Measure | null} */
  measure = null;

  /** @param {() => void} onChange the layer is to be painted again */
  constructor(onChange) {
    this.#peaking.addEventListener("change", onChange);
    this.#zebra.addEventListener("change", onChange);
    byId("aids-reset-peak", HTMLButtonElement).addEventListener("click", () => {
      this.#hold.reset();
      this.#showSharpness();
    });
  }

  /** @param {boolean} isShown */
  reset(isShown) {
    this.#box.hidden = !isShown;
    this.#hold.reset();
    this.measure = null;
    this.#show();
  }

  get peak() {
    return this.#hold.peak;
  }

  /** @param {Measure} measure */
  measured(measure) {
    this.measure = measure;
    this.#show();
  }

  #show() {
    this.#showSharpness();
    const percent = (/** @type {number | null} */ share) => (share === null ? "not known" : `${(share * 100).toFixed(2)} %`);
    const { measure } = this;
    setText(this.#clipped, measure === null ? "Measuring" : `Black ${percent(measure.dark)}, white ${percent(measure.bright)}`);
    this.#drawHistogram(measure?.luma ?? []);
  }

  #showSharpness() {
    const sharpness = this.measure?.sharpness ?? null;
    if (sharpness === null) {
      setText(this.#sharpness, "measuring");
      this.#focus.value = 0;
      return;
    }
    this.#focus.value = this.#hold.follow(sharpness);
    setText(this.#sharpness, `${sharpness.toFixed(1)}, peak ${this.#hold.peak.toFixed(1)}`);
  }

  /** @param {number[]} luma shares */
  #drawHistogram(luma) {
    const { width, height } = this.#histogram;
    const context = /** @type {CanvasRenderingContext2D} */ (this.#histogram.getContext("2d"));
    context.clearRect(0, 0, width, height);
    const bar = width / Math.max(1, luma.length);
    barHeights(luma).forEach((share, i) => {
      const isEnd = i === 0 || i === luma.length - 1;
      context.fillStyle = isEnd ? CLIPPED_COLOR : HISTOGRAM_COLOR;
      context.fillRect(i * bar, height * (1 - share), Math.max(1, bar - 1), height * share);
    });
  }

  /**
   * What is painted over the image; `null` for nothing.
   *
   * @param {() => Uint8ClampedArray} read the pixels, which are expensive to read
   * @param {number} columns
   * @returns {((overlay: Uint32Array) => void) | null}
   */
  paint(read, columns) {
    const isPeaking = this.#peaking.checked;
    const isZebra = this.#zebra.checked;
    if (!isPeaking && !isZebra) {
      return null;
    }
    return (overlay) => {
      const rgba = read();
      if (isZebra) {
        markClipped(rgba, columns, overlay);
      }
      if (isPeaking) {
        markPeaks(lumaOf(rgba), columns, overlay);
      }
    };
  }
}
