/** What the status says about the recording: state, rate and new losses, from one status to the next. */

import { total } from "./words.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").RecordingStatus} RecordingStatus */
/** @typedef {"idle" | "recording" | "closing"} RecordState */
/** @typedef {{utcNs: number, bytes: number}} Sample */

const RATE_OVER_NS = 5e9;

/**
 * @typedef {Object} RecordFacts
 * @property {RecordState} state
 * @property {number | null} bytesPerSecond `null` before it is known
 * @property {import("./words.js").Losses} sets lost
 * @property {import("./words.js").Losses} missing frames that sets lack, by stream
 * @property {import("./words.js").Losses} frames lost since the recording began
 * @property {boolean} hasNewLosses since the status before, while recording
 */

/**
 * Whether a status is older than the answer to a start or a stop. It may come after it, since it waits on its
 * connection behind images.
 *
 * @param {RecordingStatus} answer
 * @param {Status} status
 */
export function isOlder(answer, status) {
  if (answer.active) {
    return status.utc_ns < answer.started_utc_ns;
  }
  return status.recording !== null && status.recording.path === answer.path && status.recording.active;
}

/**
 * @param {RecordingStatus} recording
 * @param {boolean} isStopping
 * @returns {RecordState}
 */
function stateOf(recording, isStopping) {
  if (!recording.active) {
    return "idle";
  }
  return isStopping || recording.closing ? "closing" : "recording";
}

export class RecordingWatch {
  /** The recording that the numbers are of: its folder. */
  #path = "";
  #lost = 0;
  /** @type {Sample[]} */
  #samples = [];

  /**
   * @param {Status} status
   * @param {boolean} isStopping whether this page waits for the answer to its own stop
   * @returns {RecordFacts}
   */
  follow(status, isStopping) {
    const { recording } = status;
    const isNew = recording !== null && recording.path !== this.#path;
    if (recording === null || isNew) {
      this.#begin(recording);
    }
    if (recording === null) {
      return { state: "idle", bytesPerSecond: null, sets: {}, missing: {}, frames: {}, hasNewLosses: false };
    }
    const state = stateOf(recording, isStopping);
    const { dropped: sets, missing, frames_dropped: frames } = recording;
    const lost = total(sets) + total(missing) + total(frames);
    const hasNewLosses = recording.active && !isNew && lost > this.#lost;
    this.#lost = recording.active ? lost : 0;
    const bytesPerSecond = this.#rate(recording, status.utc_ns);
    return { state, bytesPerSecond, sets, missing, frames, hasNewLosses };
  }

  /** @param {RecordingStatus | null} recording */
  #begin(recording) {
    this.#path = recording?.path ?? "";
    this.#lost = 0;
    this.#samples = [];
  }

  /**
   * @param {RecordingStatus} recording
   * @param {number} utcNs
   */
  #rate(recording, utcNs) {
    this.#samples.push({ utcNs, bytes: recording.bytes });
    while (this.#samples.length > 2 && utcNs - this.#samples[0].utcNs > RATE_OVER_NS) {
      this.#samples.shift();
    }
    const first = this.#samples[0];
    const seconds = (utcNs - first.utcNs) / 1e9;
    return recording.active && seconds >= 1 ? Math.max(0, recording.bytes - first.bytes) / seconds : null;
  }
}
