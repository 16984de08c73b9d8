/** The replay bar: where a replay is, and the controls of `/v1/replay`. */

import { post } from "./api.js";
import { byId, setState, setText } from "./dom.js";
import { play } from "./sound.js";
import { clock } from "./words.js";

/** @typedef {import("./types.js").ReplayStatus} ReplayStatus */
/** @typedef {"pause" | "resume" | "seek" | "step" | "rate" | "loop"} ReplayCommand */

/** A dataset beside the live rig is steered over its connection, which answers with the next status. */
const ANSWER_MS = 150;
/** A status that was sent before the seek must not move the slider back. */
const SETTLE_MS = 700;

export class ReplayBar {
  #bar = byId("replay", HTMLElement);
  #pause = byId("replay-pause", HTMLButtonElement);
  #rate = byId("replay-rate", HTMLSelectElement);
  #loop = byId("replay-loop", HTMLInputElement);
  #scrub = byId("scrub", HTMLInputElement);
  #position = byId("replay-position", HTMLElement);
  #message = byId("replay-message", HTMLElement);
  /** @type {ReplayStatus | null} */
  #status = null;
  #isSeeking = false;
  /** @type {number | null} the newest set asked for while a seek is answered */
  #wantedSet = null;
  #isHeld = false;
  #soughtAt = -Infinity;
  #name = byId("replay-dataset", HTMLElement);
  #back = byId("back-to-live", HTMLButtonElement);
  /** @type {string | null} the dataset that is shown beside the live rig */
  #dataset = null;
  #steer;

  /**
   * @param {(command: ReplayCommand, body: Record<string, unknown>) => void} steer a dataset beside the live rig
   * @param {() => void} onBack
   */
  constructor(steer, onBack) {
    this.#steer = steer;
    this.#back.addEventListener("click", onBack);
    this.#pause.addEventListener("click", () => this.togglePause());
    byId("replay-back", HTMLButtonElement).addEventListener("click", () => this.step(-1));
    byId("replay-forward", HTMLButtonElement).addEventListener("click", () => this.step(1));
    this.#rate.addEventListener("change", () => void this.#ask("rate", { rate: Number(this.#rate.value) }));
    this.#loop.addEventListener("change", () => void this.#ask("loop", { on: this.#loop.checked }));
    this.#scrub.addEventListener("input", () => void this.#seek(this.#scrub.valueAsNumber));
    this.#scrub.addEventListener("pointerdown", () => (this.#isHeld = true));
    addEventListener("pointerup", () => (this.#isHeld = false));
    addEventListener("pointercancel", () => (this.#isHeld = false));
  }

  get isShown() {
    return !this.#bar.hidden;
  }

  /** Whether no new images are to be expected. */
  get isWaiting() {
    return this.#status !== null && (this.#status.paused || this.#status.done);
  }

  /** Images of a stream that come at most, Hz: one of each set. Not limited without a replay. */
  get fastestHz() {
    const status = this.#status;
    if (status === null || status.as_fast_as_possible || status.length_s <= 0) {
      return Infinity;
    }
    return ((status.length_sets - 1) / status.length_s) * status.rate;
  }

  /**
   * @param {boolean} isReplay
   * @param {string | null} dataset that is shown beside the live rig
   */
  show(isReplay, dataset) {
    this.#dataset = dataset;
    this.#status = null;
    this.#bar.hidden = !isReplay;
    this.#back.hidden = dataset === null;
    setText(this.#name, dataset ?? "");
    setText(this.#message, "");
    document.body.classList.toggle("is-replay", isReplay);
  }

  togglePause() {
    void this.#ask(this.#status?.paused ? "resume" : "pause", {});
  }

  /** @param {number} sets */
  step(sets) {
    void this.#ask("step", { sets });
  }

  /** @param {ReplayStatus | null} status */
  update(status) {
    this.#status = status;
    if (status === null) {
      return;
    }
    const set = status.set ?? 0;
    setText(this.#pause, status.paused ? "Play" : "Pause");
    setState(this.#bar, status.done ? "done" : status.paused ? "paused" : "playing");
    const paused = status.done ? " · at the end" : status.paused ? " · paused" : "";
    const where = `${clock(status.position_s)} / ${clock(status.length_s)} · set ${set + 1} of ${status.length_sets}`;
    setText(this.#position, where + paused);
    this.#scrub.max = String(Math.max(0, status.length_sets - 1));
    // The slider belongs to the hand that holds it.
    const isSettled = performance.now() - this.#soughtAt > SETTLE_MS;
    if (!this.#isHeld && !this.#isSeeking && isSettled) {
      this.#scrub.value = String(set);
    }
    this.#scrub.setAttribute("aria-valuetext", where);
    if (document.activeElement !== this.#rate) {
      this.#showRate(status);
    }
    this.#loop.checked = status.loop;
    const lost = status.lost.length > 0 ? `${status.lost.length} read errors, the last: ${status.lost.at(-1)}` : "";
    const waits = status.waiting_for === null ? "" : `Waits for ${status.waiting_for}`;
    setText(byId("replay-losses", HTMLElement), [waits, lost].filter((text) => text !== "").join("; "));
  }

  /** @param {ReplayStatus} status */
  #showRate(status) {
    const value = status.as_fast_as_possible ? "" : String(status.rate);
    const isListed = [...this.#rate.options].some((option) => option.value === value);
    if (!isListed) {
      const option = document.createElement("option");
      option.value = value;
      option.textContent = value === "" ? "as fast as possible" : `${value}×`;
      option.disabled = value === "";
      this.#rate.append(option);
    }
    this.#rate.value = value;
  }

  /**
   * Goes to a set. While one seek is answered only the newest of the others is kept.
   *
   * @param {number} set
   */
  async #seek(set) {
    this.#wantedSet = set;
    if (this.#isSeeking) {
      return;
    }
    this.#isSeeking = true;
    while (this.#wantedSet !== null) {
      const wanted = this.#wantedSet;
      this.#wantedSet = null;
      await this.#ask("seek", { set: wanted });
    }
    this.#soughtAt = this.#dataset === null ? -Infinity : performance.now();
    this.#isSeeking = false;
  }

  /**
   * @param {ReplayCommand} command
   * @param {Record<string, unknown>} body
   */
  async #ask(command, body) {
    if (this.#dataset !== null) {
      this.#steer(command, body);
      await new Promise((answered) => setTimeout(answered, ANSWER_MS));
      return;
    }
    try {
      const status = /** @type {ReplayStatus} */ (await post(`/v1/replay/${command}`, body));
      setText(this.#message, "");
      this.update(status);
    } catch (error) {
      setText(this.#message, error instanceof Error ? error.message : String(error));
      play("error");
    }
  }
}
