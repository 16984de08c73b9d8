/** How a recording stands, in words: pure functions. */

import { lossAdvice } from "./advice.js";
import { clock, disk, lossesInWords, missingInWords, size, total } from "./words.js";

/** @typedef {import("./types.js").RecordingStatus} RecordingStatus */
/** @typedef {import("./recording.js").RecordFacts} RecordFacts */

/**
 * @typedef {Object} RecordTexts
 * @property {string} progress
 * @property {string} losses
 * @property {string} advice what to do about them
 * @property {"none" | "few" | "lost"} losing "few": what no set lacks
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
    return { progress: "Nothing recorded yet", losses: "", advice: "", losing: "none", disk: "", warning: "" };
  }
  const { sets, missing, frames } = facts;
  const losses = [lossesInWords("set", sets), missingInWords(missing), lossesInWords("frame", frames)];
  const text = losses.filter((loss) => loss !== "").join("; ");
  const secondsLeft = recording.active ? recording.disk_seconds_left : null;
  return {
    progress: progressOf(recording, facts),
    losses: text || "No losses",
    advice: lossAdvice(sets, missing, frames),
    losing: text === "" ? "none" : total(sets) + total(missing) > 0 ? "lost" : "few",
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
