/** One recording of the list: its image, what is known of it, and what can be done with it. */

import { make, makeButton, makeText, setState, setText } from "./dom.js";
import { healthText, numbersOf, titleOf, when, whyNotWatched } from "./recordingtext.js";

/** @typedef {import("./paneltypes.js").RecordingEntry} RecordingEntry */
/** @typedef {import("./paneltypes.js").Mark} Mark */

const IMAGE_WIDTH = 128;
const IMAGE_HEIGHT = 80;

/**
 * @typedef {Object} RowActions
 * @property {(entry: RecordingEntry, mark: Mark) => void} mark
 * @property {(entry: RecordingEntry) => void} watch
 * @property {(entry: RecordingEntry) => void} report
 */

export class RecordingRow {
  element = make("li", "recording");
  #canvas = document.createElement("canvas");
  #noImage = makeText("span", "no-image", "no image");
  #title = make("strong", "recording-title");
  #health = make("span", "health");
  #facts = make("span", "quiet");
  #numbers = make("span", "recording-numbers");
  #why = make("p", "why");
  #good;
  #bad;
  #watch;
  #report;
  hasImage = false;
  /** The health it had when its image was asked for; empty: it was not. */
  imageAskedAs = "";

  /**
   * @param {RecordingEntry} entry
   * @param {RowActions} actions
   */
  constructor(entry, actions) {
    this.entry = entry;
    this.#good = makeButton("Good", () => actions.mark(this.entry, this.entry.mark === "good" ? null : "good"));
    this.#bad = makeButton("Bad", () => actions.mark(this.entry, this.entry.mark === "bad" ? null : "bad"));
    this.#watch = makeButton("Watch", () => actions.watch(this.entry));
    this.#report = makeButton("Report", () => actions.report(this.entry));
    this.#good.className = "mark-good";
    this.#bad.className = "mark-bad";
    this.#canvas.width = IMAGE_WIDTH;
    this.#canvas.height = IMAGE_HEIGHT;
    this.#canvas.setAttribute("role", "img");
    this.#canvas.hidden = true;
    const thumb = make("div", "thumb");
    thumb.append(this.#canvas, this.#noImage);
    const head = make("div", "recording-head");
    head.append(this.#title, this.#health);
    const buttons = make("div", "buttons");
    buttons.append(this.#good, this.#bad, this.#watch, this.#report);
    const text = make("div", "recording-text");
    text.append(head, this.#facts, this.#numbers, this.#why, buttons);
    this.element.append(thumb, text);
    this.update(entry);
  }

  /** @param {RecordingEntry} entry */
  update(entry) {
    this.entry = entry;
    const title = titleOf(entry);
    this.element.dataset.name = entry.name;
    this.element.dataset.mark = entry.mark ?? "none";
    setState(this.element, entry.health);
    setText(this.#title, title);
    setText(this.#health, healthText(entry));
    setText(this.#facts, [when(entry.started_utc_ns), entry.operator, entry.name].filter(Boolean).join(" · "));
    this.#facts.title = entry.path;
    setText(this.#numbers, numbersOf(entry));
    setText(this.#why, (entry.why ?? []).join("; "));
    this.#canvas.setAttribute("aria-label", `Image of ${entry.name}`);
    this.#good.setAttribute("aria-pressed", String(entry.mark === "good"));
    this.#bad.setAttribute("aria-pressed", String(entry.mark === "bad"));
    const why = whyNotWatched(entry);
    this.#watch.disabled = why !== "";
    this.#watch.title = why;
    this.#good.disabled = why !== "";
    this.#bad.disabled = why !== "";
    this.#report.hidden = !entry.has_report;
    for (const button of [this.#good, this.#bad, this.#watch, this.#report]) {
      // All rows have the same words on their buttons.
      button.setAttribute("aria-label", `${button.textContent} ${entry.name}`);
    }
  }

  /** @param {boolean} isWatched */
  setWatched(isWatched) {
    this.element.classList.toggle("is-watched", isWatched);
  }

  /** @param {ImageBitmap} bitmap */
  showImage(bitmap) {
    const context = /** @type {CanvasRenderingContext2D} */ (this.#canvas.getContext("2d"));
    const scale = Math.max(IMAGE_WIDTH / bitmap.width, IMAGE_HEIGHT / bitmap.height);
    const width = bitmap.width * scale;
    const height = bitmap.height * scale;
    context.drawImage(bitmap, (IMAGE_WIDTH - width) / 2, (IMAGE_HEIGHT - height) / 2, width, height);
    bitmap.close();
    this.hasImage = true;
    this.#canvas.hidden = false;
    this.#noImage.hidden = true;
  }
}
