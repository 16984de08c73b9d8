/** The strip in the record bar that shows when the recording lost something. */

import { get } from "./api.js";
import { make, makeText, setText } from "./dom.js";
import { CAUSES, barsOf, causesOf, lengthOf, momentAt, momentText, momentsOf, summaryText } from "./losstime.js";

/** @typedef {import("./types.js").RecordingStatus} RecordingStatus */
/** @typedef {import("./types.js").RecordingLosses} RecordingLosses */

/** New losses are asked for at most so often. */
const EVERY_MS = 1000;
/** A pointer this near a moment means it. */
const SLACK_PX = 6;
const LEAST_BAR_PX = 3;
const CHOSEN_COLOR = "#fff";

export class LossStrip {
  #box;
  #strip = make("div", "loss-strip");
  #canvas = document.createElement("canvas");
  #moment = document.createElement("input");
  #text = makeText("span", "loss-moment", "");
  #causes = make("span", "loss-causes");
  /** @type {RecordingStatus | null} */
  #recording = null;
  #setsHz = 0;
  /** @type {RecordingLosses | null} */
  #losses = null;
  /** @type {import("./losstime.js").Moment[]} */
  #moments = [];
  /** What the losses were asked for: the recording and its counts. */
  #askedFor = "";
  #askedAt = -Infinity;
  #isAsking = false;
  /** The moment under the pointer; -1: none. */
  #pointed = -1;

  /** @param {HTMLElement} box */
  constructor(box) {
    this.#box = box;
    this.#canvas.setAttribute("aria-hidden", "true");
    this.#moment.type = "range";
    this.#moment.min = "0";
    this.#moment.step = "1";
    this.#moment.value = "0";
    this.#moment.setAttribute("aria-label", "Moments with losses");
    this.#strip.append(this.#canvas, this.#moment);
    const line = make("p", "loss-text");
    line.append(this.#text, this.#causes);
    box.append(this.#strip, line);
    for (const event of /** @type {const} */ (["input", "focus", "blur"])) {
      this.#moment.addEventListener(event, () => this.#draw());
    }
    this.#strip.addEventListener("pointermove", (event) => this.#point(event.clientX));
    this.#strip.addEventListener("pointerdown", (event) => this.#point(event.clientX));
    this.#strip.addEventListener("pointerleave", () => this.#point(NaN));
    new ResizeObserver(() => this.#draw()).observe(this.#strip);
  }

  /**
   * @param {RecordingStatus | null} recording `null`: nothing was lost
   * @param {number} setsHz
   */
  follow(recording, setsHz) {
    this.#recording = recording;
    this.#setsHz = setsHz;
    if (recording === null || recording.path !== this.#losses?.path) {
      this.#box.hidden = true;
    }
    if (recording !== null) {
      void this.#ask(recording);
      this.#draw();
    }
  }

  /** @param {RecordingStatus} recording */
  async #ask(recording) {
    const { path, dropped, missing, frames_dropped: frames } = recording;
    const wanted = JSON.stringify([path, dropped, missing, frames]);
    const now = performance.now();
    if (wanted === this.#askedFor || this.#isAsking || now - this.#askedAt < EVERY_MS) {
      return;
    }
    this.#isAsking = true;
    this.#askedAt = now;
    try {
      const losses = /** @type {RecordingLosses | null} */ (await get("/v1/record/losses"));
      if (losses !== null && losses.path === path) {
        this.#askedFor = wanted;
        this.#losses = losses;
        this.#moments = momentsOf(losses);
        this.#moment.max = String(Math.max(0, this.#moments.length - 1));
        this.#pointed = -1;
        this.#draw();
      }
    } catch {
      // The connection says so when the daemon has gone; it is asked again with the next status.
    } finally {
      this.#isAsking = false;
    }
  }

  /** @param {number} clientX NaN: the pointer has left */
  #point(clientX) {
    const losses = this.#losses;
    const recording = this.#recording;
    const box = this.#strip.getBoundingClientRect();
    if (losses === null || recording === null || box.width === 0) {
      return;
    }
    const secondsOfPixel = lengthOf(losses, recording.duration_s) / box.width;
    const at = (clientX - box.left) * secondsOfPixel;
    this.#pointed = Number.isNaN(at) ? -1 : momentAt(this.#moments, at, SLACK_PX * secondsOfPixel);
    this.#draw();
  }

  /** The moment whose text is shown; -1: that of the whole strip. */
  get #chosen() {
    if (this.#pointed >= 0) {
      return this.#pointed;
    }
    return document.activeElement === this.#moment ? this.#moment.valueAsNumber : -1;
  }

  #draw() {
    const losses = this.#losses;
    const recording = this.#recording;
    if (losses === null || recording === null || losses.path !== recording.path) {
      return;
    }
    this.#box.hidden = false;
    const length = lengthOf(losses, recording.duration_s);
    const bars = barsOf(losses, recording.duration_s, this.#setsHz);
    this.#drawBars(bars, length);
    const chosen = this.#moments[this.#chosen];
    setText(this.#text, chosen === undefined ? summaryText(this.#moments, length) : momentText(chosen));
    const focused = this.#moments[this.#moment.valueAsNumber];
    const place = `${this.#moment.valueAsNumber + 1} of ${this.#moments.length}`;
    this.#moment.setAttribute("aria-valuetext", focused === undefined ? "none" : `${place}: ${momentText(focused)}`);
    this.#showCauses(causesOf(bars));
  }

  /**
   * @param {import("./losstime.js").Bar[]} bars
   * @param {number} lengthS
   */
  #drawBars(bars, lengthS) {
    const canvas = this.#canvas;
    canvas.width = Math.max(1, Math.round(this.#strip.clientWidth * devicePixelRatio));
    canvas.height = Math.max(1, Math.round(this.#strip.clientHeight * devicePixelRatio));
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    const least = Math.ceil(LEAST_BAR_PX * devicePixelRatio);
    for (const { left, width, height, cause } of bars) {
      context.fillStyle = CAUSES[cause].color;
      // Whole pixels: neighbours leave no seam.
      const x = Math.min(Math.round(left * canvas.width), canvas.width - least);
      const end = Math.round((left + width) * canvas.width);
      const tall = Math.round(height * canvas.height);
      context.fillRect(x, canvas.height - tall, Math.max(least, end - x), tall);
    }
    const chosen = this.#moments[this.#chosen];
    if (chosen !== undefined) {
      const x = (chosen.fromS / lengthS) * canvas.width;
      context.strokeStyle = CHOSEN_COLOR;
      context.lineWidth = 2 * devicePixelRatio;
      context.strokeRect(x, 1, Math.max(least, ((chosen.toS - chosen.fromS) / lengthS) * canvas.width), canvas.height - 2);
    }
  }

  /** @param {import("./losstime.js").Cause[]} causes */
  #showCauses(causes) {
    const shown = causes.join(" ");
    if (this.#causes.dataset.causes === shown) {
      return;
    }
    this.#causes.dataset.causes = shown;
    this.#causes.replaceChildren(
      ...causes.map((cause) => {
        const part = makeText("span", "loss-cause", CAUSES[cause].name);
        const swatch = make("span", "swatch");
        swatch.style.background = CAUSES[cause].color;
        part.prepend(swatch);
        return part;
      }),
    );
  }
}
