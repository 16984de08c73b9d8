/** State of a tile in one word, and in words with the cure: pure functions. */

import { age } from "./words.js";

/** @typedef {import("./types.js").CameraStatus} CameraStatus */
/** @typedef {{state: "live" | "stale" | "waiting" | "failed", message: string}} TileState */

/** So long after an image was due, the tile is stale. */
export const STALE_MS = 500;

/**
 * @typedef {Object} TileFacts
 * @property {CameraStatus} camera
 * @property {number} now ms
 * @property {number} drawnAt ms; -Infinity before the first image
 * @property {number} watchedSince ms
 * @property {number} periodMs between images
 * @property {boolean} isLive whether the daemon answers
 * @property {boolean} isPaused whether a replay is paused or at its end
 * @property {string} preparing why the first image takes so long
 */

/**
 * @param {string} word
 * @param {string | null} message
 */
function withMessage(word, message) {
  return message === null || message === "" ? word : `${word}: ${message}`;
}

/**
 * @param {TileFacts} facts
 * @returns {TileState}
 */
export function tileState(facts) {
  const { camera, now, drawnAt } = facts;
  if (!facts.isLive) {
    const state = drawnAt === -Infinity ? "waiting" : "stale";
    return { state, message: "No connection to the daemon" };
  }
  switch (camera.state) {
    case "failed":
      return { state: "failed", message: withMessage("Failed", camera.message) };
    case "reconnecting":
      return { state: "failed", message: withMessage("Lost; it is opened again", camera.message) };
    case "stalled":
      return { state: "stale", message: withMessage("Stalled", camera.message) };
    case "finished":
      return { state: "stale", message: withMessage("Finished", camera.message) };
    case "stopped":
      return { state: "stale", message: withMessage("Stopped", camera.message) };
    case "opening":
      return { state: "waiting", message: withMessage("Opening", camera.message) };
    case "streaming":
      return streamingState(facts, now, drawnAt);
  }
}

/**
 * @param {TileFacts} facts
 * @param {number} now
 * @param {number} drawnAt
 * @returns {TileState}
 */
function streamingState(facts, now, drawnAt) {
  if (drawnAt === -Infinity) {
    return { state: "waiting", message: facts.preparing || "Waiting for the first image" };
  }
  const since = now - Math.max(drawnAt, facts.watchedSince);
  if (since <= STALE_MS + facts.periodMs) {
    return { state: "live", message: facts.camera.warnings?.join("; ") ?? "" };
  }
  // The image of a replay that waits is the one that is meant, however old.
  if (facts.isPaused) {
    return { state: "live", message: "" };
  }
  return { state: "stale", message: `No new image for ${age(now - drawnAt)}` };
}

/**
 * Time between images that are asked for at `rateHz` of a stream of `nominalHz`.
 *
 * @param {number} rateHz
 * @param {number} nominalHz 0 when unknown
 */
export function periodMs(rateHz, nominalHz) {
  return 1000 / (nominalHz > 0 ? Math.min(rateHz, nominalHz) : rateHz);
}
