/** A recording of the list in words: pure functions. */

import { clock, size } from "./words.js";

/** @typedef {import("./paneltypes.js").RecordingEntry} RecordingEntry */
/** @typedef {import("./paneltypes.js").Health} Health */

/** @type {Record<Health, string>} */
const HEALTH = {
  whole: "Whole",
  recording: "Being recorded",
  lost: "Something lost",
  unfinished: "Not closed",
  damaged: "Damaged",
};

/** @param {RecordingEntry} entry */
export function healthText(entry) {
  // A later daemon may know other words.
  return HEALTH[entry.health] ?? String(entry.health);
}

/** @param {RecordingEntry} entry */
export function titleOf(entry) {
  return entry.scene || "no scene";
}

/**
 * Local date and time, as the operator's clock shows it.
 *
 * @param {number | null} utcNs
 */
export function when(utcNs) {
  if (utcNs === null || utcNs === undefined || utcNs <= 0) {
    return "unknown time";
  }
  const date = new Date(utcNs / 1e6);
  const two = (/** @type {number} */ n) => String(n).padStart(2, "0");
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return `${day} ${two(date.getHours())}:${two(date.getMinutes())}`;
}

/**
 * @param {number} n
 * @param {string} noun
 */
function counted(n, noun) {
  return `${n} ${noun}${n === 1 ? "" : "s"}`;
}

/** @param {RecordingEntry} entry */
export function numbersOf(entry) {
  const { duration_ns, sets, sets_lost, streams, bytes } = entry;
  const count = Array.isArray(streams) ? streams.length : streams;
  const parts = [
    duration_ns === null || duration_ns === undefined ? "" : clock(duration_ns / 1e9),
    sets === null || sets === undefined ? "" : counted(sets, "set"),
    sets_lost ? `${sets_lost} lost` : "",
    count ? counted(count, "stream") : "",
    bytes === null || bytes === undefined ? "" : size(bytes),
  ];
  return parts.filter((part) => part !== "").join(" · ");
}

/**
 * Why a recording cannot be watched; empty if it can.
 *
 * @param {RecordingEntry} entry
 */
export function whyNotWatched(entry) {
  return entry.health === "recording" ? "It is being recorded" : "";
}
