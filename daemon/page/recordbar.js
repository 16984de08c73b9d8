/** The record bar: start, stop, notes, and how the recording stands. */

import { ApiError, post } from "./api.js";
import { announce, byId, setState, setText, store, stored } from "./dom.js";
import { RecordingWatch, isOlder } from "./recording.js";
import { recordTexts } from "./recordtext.js";
import { addScene, parseScenes } from "./scenes.js";
import { play } from "./sound.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./recording.js").RecordState} RecordState */

const SCENES_KEY = "depthrig-scenes";
const OPERATOR_KEY = "depthrig-operator";
/** New losses sound at most so often. */
const LOSS_SOUND_MS = 2000;
/** An older status may come so long after an answer; a clock that is set back must not stop the bar for longer. */
const ANSWER_MS = 3000;

/** @type {Record<RecordState, string>} */
const STATE_TEXT = { idle: "Idle", recording: "Recording", closing: "Closing" };

export class RecordBar {
  #bar = byId("record", HTMLElement);
  #scene = byId("scene", HTMLInputElement);
  #operator = byId("operator", HTMLInputElement);
  #notes = byId("notes", HTMLInputElement);
  #notesLabel = byId("notes-label", HTMLElement);
  #button = byId("start-stop", HTMLButtonElement);
  #force = byId("force-start", HTMLButtonElement);
  #addNote = byId("add-note", HTMLButtonElement);
  #state = byId("record-state", HTMLElement);
  #progress = byId("record-progress", HTMLElement);
  #losses = byId("losses", HTMLElement);
  #disk = byId("disk", HTMLElement);
  #error = byId("record-error", HTMLElement);
  #warning = byId("record-warning", HTMLElement);
  #watch = new RecordingWatch();
  /** @type {Status | null} */
  #status = null;
  /** @type {RecordState | null} `null` before the first status */
  #shown = null;
  /** @type {"start" | "stop" | null} a request that waits for its answer */
  #request = null;
  /** @type {import("./types.js").RecordingStatus | null} to the last start or stop */
  #answer = null;
  #answeredAt = -Infinity;
  #lossSoundAt = -Infinity;
  #toldError = "";
  #isLive = false;

  constructor() {
    this.#operator.value = stored(OPERATOR_KEY) ?? "";
    this.#offerScenes(parseScenes(stored(SCENES_KEY)));
    this.#button.addEventListener("click", () => this.toggle());
    this.#force.addEventListener("click", () => void this.#start(true));
    this.#addNote.addEventListener("click", () => void this.#note());
    this.#notes.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.isComposing) {
        void this.#note();
      }
    });
    this.#enable();
  }

  /** Starts a recording, or stops the one that goes on. */
  toggle() {
    if (!this.#isReady) {
      return;
    }
    void (this.#shown === "recording" ? this.#stop() : this.#start(false));
  }

  /** Whether a start or a stop can be asked for. */
  get #isReady() {
    return this.#isLive && this.#request === null && (this.#shown === "idle" || this.#shown === "recording");
  }

  focusNotes() {
    this.#notes.focus();
    this.#notes.select();
  }

  /** @param {boolean} isLive */
  setLive(isLive) {
    this.#isLive = isLive;
    this.#bar.classList.toggle("is-old", !isLive);
    this.#enable();
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    const answer = performance.now() - this.#answeredAt < ANSWER_MS ? this.#answer : null;
    if (answer !== null && isOlder(answer, status)) {
      return;
    }
    const facts = this.#watch.follow(status, this.#request === "stop");
    const { recording } = status;
    this.#setState(facts.state);
    const texts = recordTexts(recording, facts);
    setText(this.#progress, texts.progress);
    setText(this.#losses, texts.losses);
    setState(this.#losses, texts.hasLosses ? "lost" : "none");
    setText(this.#disk, texts.disk);
    setText(this.#warning, texts.warning);
    this.#sound(facts.hasNewLosses, recording?.error ?? "");
  }

  /**
   * @param {boolean} hasNewLosses
   * @param {string} error
   */
  #sound(hasNewLosses, error) {
    const now = performance.now();
    if (hasNewLosses && now - this.#lossSoundAt > LOSS_SOUND_MS) {
      this.#lossSoundAt = now;
      play("loss");
    }
    if (error !== "" && error !== this.#toldError) {
      play("error");
    }
    this.#toldError = error;
  }

  /** @param {RecordState} state */
  #setState(state) {
    const before = this.#shown;
    this.#shown = state;
    if (before !== state) {
      setState(this.#bar, state);
      setState(this.#state, state);
      setText(this.#state, STATE_TEXT[state]);
      if (before !== null) {
        announce(STATE_TEXT[state]);
        if (state === "recording") {
          play("start");
        } else if (before === "recording") {
          play("stop");
        }
      }
    }
    this.#enable();
  }

  #enable() {
    const isRecording = this.#shown === "recording";
    setText(this.#button, isRecording ? "Stop" : "Start");
    this.#button.disabled = !this.#isReady;
    this.#addNote.disabled = !this.#isLive || !isRecording;
    this.#scene.disabled = isRecording;
    this.#operator.disabled = isRecording;
    setText(this.#notesLabel, isRecording ? "Note now" : "Notes");
  }

  /** @param {boolean} force */
  async #start(force) {
    const scene = this.#scene.value.trim();
    const operator = this.#operator.value.trim();
    const body = { scene, operator, notes: this.#notes.value.trim(), ...(force ? { force } : {}) };
    if (!(await this.#ask("start", "/v1/record/start", body))) {
      return;
    }
    this.#notes.value = "";
    store(OPERATOR_KEY, operator);
    const scenes = addScene(parseScenes(stored(SCENES_KEY)), scene);
    store(SCENES_KEY, JSON.stringify(scenes));
    this.#offerScenes(scenes);
  }

  #stop() {
    this.#setState("closing");
    return this.#ask("stop", "/v1/record/stop", {});
  }

  async #note() {
    const text = this.#notes.value.trim();
    if (text === "" || this.#shown !== "recording") {
      return;
    }
    if (await this.#ask(null, "/v1/record/note", { text })) {
      this.#notes.value = "";
      this.#notes.blur();
      announce("Note added");
    }
  }

  /**
   * @param {"start" | "stop" | null} request what the bar waits for
   * @param {string} path
   * @param {Record<string, unknown>} body
   * @returns {Promise<boolean>} whether it was done
   */
  async #ask(request, path, body) {
    this.#request = request ?? this.#request;
    this.#force.hidden = true;
    setText(this.#error, "");
    this.#enable();
    try {
      // Closing takes as long as the disk needs.
      const answer = await post(path, body, request === "stop" ? 0 : undefined);
      if (request !== null && this.#status !== null) {
        const recording = /** @type {import("./types.js").RecordingStatus} */ (answer);
        this.#request = null;
        this.#answer = null;
        this.update({ ...this.#status, recording });
        this.#answer = recording;
        this.#answeredAt = performance.now();
      }
      return true;
    } catch (error) {
      const isFull = error instanceof ApiError && error.kind === "no_space";
      this.#force.hidden = !(isFull && request === "start");
      setText(this.#error, error instanceof Error ? error.message : String(error));
      play("error");
      return false;
    } finally {
      if (request !== null) {
        this.#request = null;
      }
      this.#enable();
    }
  }

  /** @param {string[]} scenes */
  #offerScenes(scenes) {
    const options = scenes.map((scene) => {
      const option = document.createElement("option");
      option.value = scene;
      return option;
    });
    byId("scenes", HTMLDataListElement).replaceChildren(...options);
  }
}
