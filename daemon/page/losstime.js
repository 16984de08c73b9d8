/** When a recording lost something, over its time: pure functions. */

import { clock, lossesInWords, missingInWords, sumOf, total } from "./words.js";

/** @typedef {import("./types.js").RecordingLosses} RecordingLosses */
/** @typedef {import("./types.js").LossBucket} LossBucket */
/** @typedef {import("./words.js").Losses} Losses */
/** @typedef {"disk" | "computer" | "camera" | "end"} Cause */

/**
 * @typedef {Object} Bar shares of the strip; the first of a list lies below the others
 * @property {number} left
 * @property {number} width
 * @property {number} height
 * @property {Cause} cause
 *
 * @typedef {Object} Moment neighbouring buckets with losses
 * @property {number} fromS
 * @property {number} toS
 * @property {Losses} sets
 * @property {Losses} missing
 * @property {Losses} frames
 */

/** @type {Record<Cause, {name: string, color: string}>} bright enough on the dark strip, and apart for the colour-blind */
export const CAUSES = {
  disk: { name: "disk", color: "#ff7466" },
  computer: { name: "computer", color: "#c79bff" },
  camera: { name: "camera or cable", color: "#f2c14e" },
  end: { name: "end of the recording", color: "#a9b0ba" },
};

/** @type {Record<string, Cause>} of the reasons of sets and frames; of every other, and of missing frames, it is the camera */
const CAUSE_OF = {
  disk_slow: "disk",
  write_failed: "disk",
  encoder_busy: "computer",
  encode_failed: "computer",
  no_slot: "computer",
  queue_full: "computer",
  ended: "end",
};

/** Where each kind of loss begins and ends in height: few lost frames never look like lost sets. */
const FRAME_HEIGHTS = { least: 0.12, most: 0.25 };
const MISSING_HEIGHTS = { least: 0.3, most: 0.6 };
const SET_HEIGHTS = { least: 0.65, most: 1 };
/** So many lost frames a second fill the height of their kind. */
const MANY_FRAMES_HZ = 30;
/** Buckets so many widths apart are one moment. */
const JOINED = 2;

/** @param {string} reason */
export function causeOf(reason) {
  return CAUSE_OF[reason] ?? "camera";
}

/** @param {Losses} losses */
function mainCause(losses) {
  const [reason] = Object.entries(losses).reduce((most, entry) => (entry[1] > most[1] ? entry : most), ["", 0]);
  return causeOf(reason);
}

/**
 * The time that the strip stands for, seconds: the losses of its end may lie after the last set.
 *
 * @param {RecordingLosses} losses
 * @param {number} durationS
 */
export function lengthOf({ buckets, bucket_s: bucketS }, durationS) {
  const last = buckets.at(-1);
  return Math.max(durationS, last === undefined ? 0 : last.from_s + bucketS, bucketS);
}

/**
 * What is drawn, the tallest bar of a bucket first.
 *
 * @param {RecordingLosses} losses
 * @param {number} durationS of the recording
 * @param {number} setsHz sets a second
 * @returns {Bar[]}
 */
export function barsOf(losses, durationS, setsHz) {
  const length = lengthOf(losses, durationS);
  const sets = Math.max(1, setsHz * losses.bucket_s);
  return losses.buckets.flatMap((bucket) => {
    const left = Math.min(1, bucket.from_s / length);
    const width = Math.min(1 - left, losses.bucket_s / length);
    return [
      { of: bucket.sets, range: SET_HEIGHTS, full: sets, cause: mainCause(bucket.sets) },
      { of: bucket.missing, range: MISSING_HEIGHTS, full: sets, cause: /** @type {Cause} */ ("camera") },
      { of: bucket.frames, range: FRAME_HEIGHTS, full: MANY_FRAMES_HZ * losses.bucket_s, cause: mainCause(bucket.frames) },
    ]
      .filter(({ of }) => total(of) > 0)
      .map(({ of, range, full, cause }) => {
        const height = range.least + (range.most - range.least) * Math.min(1, total(of) / full);
        return { left, width, height, cause };
      });
  });
}

/**
 * The causes that are seen, in the order of their weight.
 *
 * @param {Bar[]} bars
 * @returns {Cause[]}
 */
export function causesOf(bars) {
  const seen = new Set(bars.map(({ cause }) => cause));
  return /** @type {Cause[]} */ (Object.keys(CAUSES)).filter((cause) => seen.has(cause));
}

/**
 * Neighbouring buckets as one.
 *
 * @param {RecordingLosses} losses
 * @returns {Moment[]}
 */
export function momentsOf({ buckets, bucket_s: bucketS }) {
  /** @type {Moment[]} */
  const moments = [];
  for (const { from_s: fromS, sets, missing, frames } of buckets) {
    const last = moments.at(-1);
    if (last !== undefined && fromS - last.toS < JOINED * bucketS) {
      last.toS = fromS + bucketS;
      last.sets = sumOf([last.sets, sets]);
      last.missing = sumOf([last.missing, missing]);
      last.frames = sumOf([last.frames, frames]);
    } else {
      moments.push({ fromS, toS: fromS + bucketS, sets, missing, frames });
    }
  }
  return moments;
}

/**
 * The moment at a place of the strip, or the nearest one within a few pixels.
 *
 * @param {Moment[]} moments
 * @param {number} atS
 * @param {number} slackS
 * @returns {number} its index; -1: none
 */
export function momentAt(moments, atS, slackS) {
  const away = moments.map(({ fromS, toS }) => Math.max(0, fromS - atS, atS - toS));
  const nearest = Math.min(...away, Infinity);
  return nearest <= slackS ? away.indexOf(nearest) : -1;
}

/** @param {Moment} moment */
export function momentText({ fromS, toS, sets, missing, frames }) {
  const what = [lossesInWords("set", sets), missingInWords(missing), lossesInWords("frame", frames)];
  return `${clock(fromS)} to ${clock(toS)}: ${what.filter((text) => text !== "").join("; ")}`;
}

/**
 * The strip in a sentence.
 *
 * @param {Moment[]} moments
 * @param {number} lengthS
 */
export function summaryText(moments, lengthS) {
  const count = moments.length === 1 ? "1 moment" : `${moments.length} moments`;
  const setsLost = total(sumOf(moments.map(({ sets }) => sets)));
  const without = setsLost === 0 ? "; no set was lost" : "";
  return `Losses at ${count} of ${clock(lengthS)}${without}`;
}
