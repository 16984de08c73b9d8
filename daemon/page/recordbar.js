/** The record bar: start, stop, notes, and how the recording stands. */

import { ApiError, messageOf, post } from "./api.js";
import { Countdown } from "./countdown.js";
import { announce, byId, setState, setText, store, stored } from "./dom.js";
import { readiness } from "./ready.js";
import { RecordingWatch, isOlder } from "./recording.js";
import { recordTexts } from "./recordtext.js";
import { addScene, parseScenes } from "./scenes.js";
import { play } from "./sound.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./recording.js").RecordState} RecordState */

const SCENES_KEY = "depthrig-scenes";
const OPERATOR_KEY = "depthrig-operator";
const COUNTDOWN_KEY = "depthrig-countdown";
/** New losses sound at most so often. */
const LOSS_SOUND_MS = 2000;
/** An older status may come so long after an answer; a clock that is set back must not stop the bar for longer. */
const ANSWER_MS = 3000;
const NOT_DONE = "Not done: ";
const NO_CONNECTION = `${NOT_DONE}this page has no connection to the daemon.`;

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
  #advice = byId("loss-advice", HTMLElement);
  #ready = byId("ready", HTMLElement);
  #disk = byId("disk", HTMLElement);
  #error = byId("record-error", HTMLElement);
  #warning = byId("record-warning", HTMLElement);
  #seconds = byId("countdown", HTMLSelectElement);
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
  /** @type {Promise<import("./lossstrip.js").LossStrip> | null} */
  #lossTime = null;
  #toldError = "";
  #isLive = false;
  #onStatus;
  /** Whether the page shows the live rig, and no dataset. */
  #isLiveRig = true;
  /** @type {import("./paneltypes.js").DoctorReport | null} */
  #doctor = null;
  #countdown = new Countdown(
    (left) => this.#counted(left),
    () => {
      this.#enable();
      void this.#start(false);
    },
  );

  /** @param {(status: Status) => void} onStatus each status that is no older than what this page knows of the recording */
  constructor(onStatus) {
    this.#onStatus = onStatus;
    this.#seconds.value = stored(COUNTDOWN_KEY) ?? "0";
    if (this.#seconds.selectedIndex < 0) {
      this.#seconds.value = "0";
    }
    this.#seconds.addEventListener("change", () => store(COUNTDOWN_KEY, this.#seconds.value));
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

  /** `null` before the first status */
  get state() {
    return this.#shown;
  }

  /** The last recording of this daemon, or the one that goes on. */
  get last() {
    return this.#status?.recording ?? null;
  }

  /** Starts a recording, after the countdown if one is chosen; stops the countdown, or the one that goes on. */
  toggle() {
    if (this.cancelCountdown()) {
      return;
    }
    const why = this.#whyNot();
    if (why !== "") {
      // Who presses a pedal looks at the robot.
      setText(this.#error, why);
      play("error");
      return;
    }
    if (this.#shown === "recording") {
      void this.stop(null);
    } else {
      this.#begin();
    }
  }

  /** @returns {boolean} whether one was running */
  cancelCountdown() {
    const wasRunning = this.#countdown.cancel();
    if (wasRunning) {
      announce("Countdown cancelled");
      this.#enable();
    }
    return wasRunning;
  }

  #begin() {
    const seconds = Number(this.#seconds.value);
    if (seconds > 0) {
      this.#countdown.start(seconds);
    } else {
      void this.#start(false);
    }
  }

  /** @param {number} left */
  #counted(left) {
    play("count");
    announce(String(left));
    this.#enable();
  }

  /**
   * Ends the recording, marks it bad and starts the next one of the same scene and operator.
   *
   * @returns {Promise<boolean>} whether it was ended and marked
   */
  async redo() {
    const before = this.last;
    if (!(await this.stop("bad"))) {
      return false;
    }
    this.#scene.value = before?.scene ?? this.#scene.value;
    this.#operator.value = before?.operator ?? this.#operator.value;
    this.#begin();
    return true;
  }

  /** Whether a start or a stop can be asked for. */
  get #isReady() {
    return this.#whyNot() === "";
  }

  /** Why neither can be asked for; empty if one can. */
  #whyNot() {
    if (!this.#isLive) {
      return NO_CONNECTION;
    }
    if (this.#shown === null) {
      return `${NOT_DONE}the daemon has not yet said whether it records.`;
    }
    if (this.#request === "start") {
      return `${NOT_DONE}the recording is being started.`;
    }
    return this.#request === "stop" || this.#shown === "closing" ? `${NOT_DONE}the last recording is being closed.` : "";
  }

  focusNotes() {
    this.#notes.focus();
    this.#notes.select();
  }

  /** @param {boolean} isLive */
  setLive(isLive) {
    this.#isLive = isLive;
    this.#bar.classList.toggle("is-old", !isLive);
    if (!isLive) {
      this.cancelCountdown();
    } else if (this.#error.textContent === NO_CONNECTION) {
      setText(this.#error, "");
    }
    this.#enable();
  }

  /** @param {boolean} isLiveRig whether the page shows the live rig, and no dataset */
  setLiveRig(isLiveRig) {
    this.#isLiveRig = isLiveRig;
    this.#status = null;
    this.#showReady();
  }

  /** @param {import("./paneltypes.js").DoctorReport} doctor */
  setDoctor(doctor) {
    this.#doctor = doctor;
    this.#showReady();
  }

  /** Whether a start would record what one wants. */
  #showReady() {
    const status = this.#status;
    if (!this.#isLiveRig) {
      setState(this.#ready, "check");
      setText(this.#ready, "A recording is of the live rig, not of the dataset that is shown");
    } else if (status === null || status.replay !== null || this.#shown !== "idle") {
      setText(this.#ready, "");
    } else {
      const { state, text } = readiness(status, this.#doctor);
      setState(this.#ready, state);
      setText(this.#ready, text);
    }
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    const answer = performance.now() - this.#answeredAt < ANSWER_MS ? this.#answer : null;
    if (answer !== null && isOlder(answer, status)) {
      return;
    }
    this.#onStatus(status);
    const facts = this.#watch.follow(status, this.#request === "stop");
    const { recording } = status;
    this.#setState(facts.state);
    const texts = recordTexts(recording, facts);
    setText(this.#progress, texts.progress);
    setText(this.#losses, texts.losses);
    setText(this.#advice, texts.advice);
    setState(this.#losses, texts.losing);
    setState(this.#advice, texts.losing);
    this.#showLossTime(recording, texts.losing !== "none", status.sets.nominal_hz);
    setText(this.#disk, texts.disk);
    setText(this.#warning, texts.warning);
    this.#showReady();
    this.#sound(facts.hasNewLosses, recording?.error ?? "");
  }

  /**
   * When the losses were. The module for it is loaded with the first one.
   *
   * @param {import("./types.js").RecordingStatus | null} recording
   * @param {boolean} hasLosses
   * @param {number} setsHz
   */
  #showLossTime(recording, hasLosses, setsHz) {
    if (hasLosses && this.#lossTime === null) {
      const load = import("./lossstrip.js").then(({ LossStrip }) => new LossStrip(byId("loss-time", HTMLElement)));
      // Without the daemon it is tried again with the next status.
      load.catch(() => (this.#lossTime = null));
      this.#lossTime = load;
    }
    void this.#lossTime?.then(
      (strip) => strip.follow(hasLosses ? recording : null, setsHz),
      () => {},
    );
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
    if (state !== "idle") {
      // Another page was quicker.
      this.cancelCountdown();
    }
    if (before !== state) {
      if (this.#error.textContent?.startsWith(NOT_DONE)) {
        setText(this.#error, "");
      }
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
    const left = this.#countdown.left;
    setText(this.#button, left > 0 ? `Cancel (${left})` : isRecording ? "Stop" : "Start");
    this.#bar.classList.toggle("is-counting", left > 0);
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
    const typed = this.#notes.value;
    const body = { scene, operator, notes: typed.trim(), ...(force ? { force } : {}) };
    if (!(await this.#ask("start", "/v1/record/start", body))) {
      return;
    }
    this.#clearNotes(typed);
    store(OPERATOR_KEY, operator);
    const scenes = addScene(parseScenes(stored(SCENES_KEY)), scene);
    store(SCENES_KEY, JSON.stringify(scenes));
    this.#offerScenes(scenes);
  }

  /**
   * @param {import("./paneltypes.js").Mark} mark
   * @returns {Promise<boolean>} whether it was done
   */
  async stop(mark) {
    if (!this.#isReady || this.#shown !== "recording") {
      return false;
    }
    this.#setState("closing");
    return this.#ask("stop", "/v1/record/stop", mark === null ? {} : { mark });
  }

  /**
   * @param {string} text
   * @returns {Promise<boolean>} whether it was done
   */
  noteText(text) {
    return this.#ask(null, "/v1/record/note", { text });
  }

  async #note() {
    const typed = this.#notes.value;
    const text = typed.trim();
    if (text === "" || this.#shown !== "recording") {
      return;
    }
    if (await this.noteText(text)) {
      if (this.#clearNotes(typed)) {
        this.#notes.blur();
      }
      announce("Note added");
    }
  }

  /**
   * Clears the notes, unless something else was typed while the daemon answered.
   *
   * @param {string} typed what was sent
   * @returns {boolean} whether they are clear
   */
  #clearNotes(typed) {
    if (this.#notes.value === typed) {
      this.#notes.value = "";
    }
    return this.#notes.value === "";
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
      setText(this.#error, messageOf(error));
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
