/** What to do about losses, by their reason: pure functions. */

import { total } from "./words.js";

/** @typedef {import("./words.js").Losses} Losses */

/** @type {Record<string, string>} */
const SET_ADVICE = {
  encoder_busy: "The computer encodes too slowly: close other programs, or record fewer or smaller streams.",
  disk_slow: "The disk takes less than the rig writes: record to a faster disk, or record fewer or smaller streams.",
  write_failed: "The disk refused data: look at its room and health, then record again.",
  encode_failed: "An image could not be encoded: the daemon's log says which one and why.",
  bad_set: "A camera delivers something else than it announced: the daemon's log says which one.",
  ended: "Sets that came while the recording was closed are not part of it. Nothing is to be done.",
};

/** @type {Record<string, string>} */
const FRAME_ADVICE = {
  device_gap: "Frames did not reach this computer: doctor (D) shows USB links that are too full; try another port or cable.",
  incomplete: "Frames came with parts missing: doctor (D) shows USB links that are too full; try another port or cable.",
  wrong_size: "Frames could not be decoded: try another cable, or a mode that is not compressed.",
  device_error: "The device flagged damage: look at its cable and its temperature.",
  out_of_order: "Frames came with a clock that went back: plug the camera in again if it goes on.",
  no_slot: "Programs that read images hold too many: close the slowest, or give the rig more slots.",
  abandoned: "A driver hung and was started again: plug the camera in again if it goes on.",
  queue_full: "A stage is too slow, such as the refining of depth: close other programs, or lower the rate.",
};

/** @param {Losses} losses */
function mostFrequent(losses) {
  return Object.entries(losses).sort((a, b) => b[1] - a[1])[0]?.[0] ?? "";
}

/**
 * One sentence about the most frequent reason, that of sets first: a set that is lost is missing from the dataset.
 *
 * @param {Losses} sets
 * @param {Losses} missing by stream
 * @param {Losses} frames
 */
export function lossAdvice(sets, missing, frames) {
  if (total(sets) > 0) {
    return SET_ADVICE[mostFrequent(sets)] ?? "The daemon's log says why.";
  }
  if (total(frames) > 0) {
    return FRAME_ADVICE[mostFrequent(frames)] ?? "The daemon's log says why.";
  }
  return total(missing) > 0 ? `Sets lack images of ${mostFrequent(missing)}: its tile and doctor (D) show how it is.` : "";
}
