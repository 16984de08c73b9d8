/** Keys that judge a take: redo, bad, good, and a mark in the recording. */

import { messageOf, post } from "./api.js";
import { announce, byId, setText } from "./dom.js";
import { DoublePress, TWICE_MS } from "./doublepress.js";
import { play } from "./sound.js";

/** @typedef {import("./paneltypes.js").Mark} Mark */
/** @typedef {import("./paneltypes.js").RecordingEntry} RecordingEntry */

const SAID_MS = 6000;

/**
 * The folder's name, which the API knows a recording by.
 *
 * @param {string} path
 */
function nameOf(path) {
  return path.split("/").filter(Boolean).at(-1) ?? "";
}

export class Takes {
  #said = byId("take-said", HTMLElement);
  #undo = byId("take-undo", HTMLButtonElement);
  #twice = new DoublePress();
  #timer = 0;
  /** @type {(() => void) | null} */
  #undoing = null;
  #bar;
  #onMarked;

  /**
   * @param {import("./recordbar.js").RecordBar} bar
   * @param {(entry: RecordingEntry) => void} onMarked
   */
  constructor(bar, onMarked) {
    this.#bar = bar;
    this.#onMarked = onMarked;
    this.#undo.addEventListener("click", () => this.#undoing?.());
  }

  /** Ends the recording, marks it bad and records again. */
  redo() {
    if (this.#bar.state !== "recording") {
      this.#say("R redoes a recording that is running.");
    } else if (this.#isSecond("Press R again: this recording is marked bad, and the next one starts.")) {
      void this.#bar.redo().then((isDone) => isDone && this.#say("Marked bad. Recording again."));
    }
  }

  /** Ends the recording and marks it bad; the last one if none is running. */
  bad() {
    if (this.#bar.state === "recording") {
      if (this.#isSecond("Press B again: the recording ends and is marked bad.")) {
        void this.#bar.stop("bad").then((isDone) => isDone && this.#say("Ended and marked bad. It is not deleted."));
      }
    } else if (this.#last() && this.#isSecond("Press B again: the last recording is marked bad.")) {
      void this.#mark("bad");
    }
  }

  good() {
    if (this.#bar.state === "recording") {
      this.#say("G marks the last recording good when none is running.");
    } else if (this.#last()) {
      void this.#mark("good");
    }
  }

  /** Adds a mark with its time to the recording. */
  async mark() {
    if (this.#bar.state !== "recording") {
      this.#say("M adds a mark to a recording that is running.");
    } else if (await this.#bar.noteText("mark")) {
      play("mark");
      this.#say("Mark added.");
    }
  }

  /**
   * Whether the question was answered by a second press. One key may ask two questions: the first press of the one must
   * not answer the other.
   *
   * @param {string} question
   */
  #isSecond(question) {
    if (this.#twice.press(question, performance.now())) {
      return true;
    }
    this.#say(question, TWICE_MS);
    return false;
  }

  /** The name of the last recording; says so when there is none. */
  #last() {
    const last = this.#bar.last;
    if (this.#bar.state === "idle" && last !== null) {
      return nameOf(last.path);
    }
    this.#say(
      this.#bar.state === "idle"
        ? "Nothing was recorded since the daemon started; older recordings are in their panel (L)."
        : "The recording is not closed yet.",
    );
    return "";
  }

  /** @param {Mark} mark */
  async #mark(mark) {
    const name = this.#last();
    try {
      const entry = /** @type {RecordingEntry} */ (await post("/v1/recordings/mark", { name, mark }));
      this.#onMarked(entry);
      play("mark");
      const undo = mark === null ? null : () => void this.#mark(null);
      this.#say(mark === null ? `The mark of ${name} is taken back.` : `Marked ${mark}: ${name}`, SAID_MS, undo);
    } catch (error) {
      play("error");
      this.#say(`${name} was not marked: ${messageOf(error)}`);
    }
  }

  /**
   * @param {string} text
   * @param {number} [forMs]
   * @param {(() => void) | null} [undo]
   */
  #say(text, forMs = SAID_MS, undo = null) {
    clearTimeout(this.#timer);
    setText(this.#said, text);
    announce(text);
    this.#undoing = undo;
    this.#undo.hidden = undo === null;
    this.#timer = setTimeout(() => {
      setText(this.#said, "");
      this.#undo.hidden = true;
    }, forMs);
  }
}
