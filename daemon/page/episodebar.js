/** The line of the episodes in the record bar: the one that runs, its task, and the keys that begin, end and judge one. */

import { messageOf, post } from "./api.js";
import { announce, byId, setState, setText, store, stored } from "./dom.js";
import { countsText, episodeState, episodeText, isAsAnswered, isRunning } from "./episodetext.js";
import { play } from "./sound.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Episode} Episode */

const TASK_KEY = "depthrig-task";
/** An older status may come so long after an answer. */
const ANSWER_MS = 3000;

export class EpisodeBar {
  #line = byId("episode", HTMLElement);
  #text = byId("episode-text", HTMLElement);
  #counts = byId("episode-counts", HTMLElement);
  #task = byId("episode-task", HTMLTextAreaElement);
  #toggle = byId("episode-toggle", HTMLButtonElement);
  #error = byId("episode-error", HTMLElement);
  /** @type {Episode | null} that runs, or the last one */
  #episode = null;
  /** @type {Episode | null} to the last command, until a status knows it */
  #answer = null;
  #answeredAt = -Infinity;
  #isLive = false;
  #isAsking = false;
  #path = "";
  #onChanged;

  /** @param {() => void} onChanged an episode was begun, ended or judged by this page */
  constructor(onChanged) {
    this.#onChanged = onChanged;
    this.#task.value = stored(TASK_KEY) ?? "";
    this.#toggle.addEventListener("click", () => this.toggle());
    byId("episode-success", HTMLButtonElement).addEventListener("click", () => this.judge("success"));
    byId("episode-failure", HTMLButtonElement).addEventListener("click", () => this.judge("failure"));
    byId("episode-discard", HTMLButtonElement).addEventListener("click", () => this.discard());
  }

  /** @param {boolean} isLive */
  setLive(isLive) {
    this.#isLive = isLive;
  }

  /** @param {Status} status of the live rig */
  update(status) {
    const { recording } = status;
    const isRecording = recording !== null && recording.active && !recording.closing;
    this.#line.hidden = !isRecording;
    if (recording === null || recording.path !== this.#path) {
      this.#path = recording?.path ?? "";
      this.#answer = null;
      this.#episode = null;
    }
    const episode = recording?.episode ?? null;
    const isOld = this.#answer !== null && !isAsAnswered(this.#answer, episode);
    if (isOld && performance.now() - this.#answeredAt < ANSWER_MS) {
      return;
    }
    this.#answer = null;
    this.#show(isRecording ? episode : null, status.replay === null ? status.utc_ns : null);
    setText(this.#counts, recording === null ? "" : countsText(recording));
  }

  /**
   * @param {Episode | null} episode
   * @param {number | null} nowUtcNs
   */
  #show(episode, nowUtcNs) {
    const before = this.#episode;
    this.#episode = episode;
    const state = episode === null ? "none" : episodeState(episode);
    setState(this.#line, state);
    setText(this.#text, episodeText(episode, nowUtcNs));
    setText(this.#toggle, this.#isRunning ? "End episode" : "Start episode");
    const wasRunning = before !== null && isRunning(before);
    if (before?.number !== episode?.number || wasRunning !== this.#isRunning) {
      announce(episodeText(episode, null));
      if (this.#isRunning || wasRunning) {
        play(this.#isRunning ? "start" : "stop");
      }
    }
  }

  get #isRunning() {
    return this.#episode !== null && isRunning(this.#episode);
  }

  focusTask() {
    if (this.#line.hidden) {
      this.#say("The task is that of an episode, and an episode is a part of a recording: start one first (Space).");
      return;
    }
    this.#task.focus();
    this.#task.select();
  }

  /** Begins an episode, or ends the one that runs. */
  toggle() {
    if (this.#isRunning) {
      void this.#ask({ action: "stop" });
    } else {
      const task = this.#task.value.trim();
      store(TASK_KEY, task);
      void this.#ask({ action: "start", task });
    }
  }

  /**
   * Ends the episode that runs with a judgement, or judges the last one.
   *
   * @param {"success" | "failure"} outcome
   */
  judge(outcome) {
    void this.#ask({ action: this.#isRunning ? "stop" : "mark", outcome });
  }

  /** The episode that runs ends and is not to be used; without one that is the last one. */
  discard() {
    void this.#ask({ action: "discard" });
  }

  /** @param {Record<string, unknown>} request */
  async #ask(request) {
    if (!this.#isLive) {
      this.#say("Not done: this page has no connection to the daemon.");
      return;
    }
    if (this.#isAsking) {
      this.#say("Not done: the daemon has not yet answered the command before.");
      return;
    }
    this.#isAsking = true;
    setText(this.#error, "");
    try {
      const episode = /** @type {Episode} */ (await post("/v1/episode", request));
      this.#answer = episode;
      this.#answeredAt = performance.now();
      this.#show(episode, isRunning(episode) ? episode.start_utc_ns : null);
      this.#onChanged();
    } catch (error) {
      this.#say(messageOf(error));
    } finally {
      this.#isAsking = false;
    }
  }

  /** @param {string} text */
  #say(text) {
    setText(this.#error, text);
    play("error");
  }
}
