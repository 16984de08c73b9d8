/** How a recording stands, in words: pure functions. */

import { lossAdvice } from "./advice.js";
import { clock, disk, lossesInWords, size } from "./words.js";

/** @typedef {import("./types.js").RecordingStatus} RecordingStatus */
/** @typedef {import("./recording.js").RecordFacts} RecordFacts */

/**
 * @typedef {Object} RecordTexts
 * @property {string} progress
 * @property {string} losses
 * @property {string} advice what to do about them
 * @property {boolean} hasLosses
 * @property {string} disk
 * @property {string} warning
 */

/**
 * @param {RecordingStatus | null} recording
 * @param {RecordFacts} facts
 * @returns {RecordTexts}
 */
export function recordTexts(recording, facts) {
  if (recording === null) {
    return { progress: "Nothing recorded yet", losses: "", advice: "", hasLosses: false, disk: "", warning: "" };
  }
  const losses = [lossesInWords("set", facts.sets), lossesInWords("frame", facts.frames)].filter((text) => text !== "");
  const secondsLeft = recording.active ? recording.disk_seconds_left : null;
  return {
    progress: progressOf(recording, facts),
    losses: losses.join("; ") || "No losses",
    advice: lossAdvice(facts.sets, facts.frames),
    hasLosses: losses.length > 0,
    disk: `Disk: ${disk(recording.disk_free_bytes, secondsLeft)}`,
    warning: [recording.error, recording.warning].filter(Boolean).join("; "),
  };
}

/**
 * @param {RecordingStatus} recording
 * @param {RecordFacts} facts
 */
function progressOf(recording, facts) {
  const parts = [clock(recording.duration_s), `${recording.sets} sets`, size(recording.bytes)];
  if (facts.state === "recording" && facts.bytesPerSecond !== null) {
    parts.push(`${(facts.bytesPerSecond / 1e6).toFixed(1)} MB/s`);
  }
  if (facts.state === "closing" && recording.backlog_bytes > 0) {
    parts.push(`${size(recording.backlog_bytes)} wait for the disk`);
  }
  parts.push(recording.name || recording.path);
  return (facts.state === "idle" ? "Last: " : "") + parts.join(" · ");
}
