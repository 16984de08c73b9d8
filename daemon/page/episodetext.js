/** Episodes in words: pure functions. */

import { clock } from "./words.js";

/** @typedef {import("./types.js").Episode} Episode */
/** @typedef {import("./types.js").RecordingStatus} RecordingStatus */
/** @typedef {"running" | "discarded" | "success" | "failure" | "kept"} EpisodeState */

/** @type {Record<EpisodeState, string>} */
export const EPISODE_TEXT = {
  running: "runs",
  discarded: "discarded",
  success: "success",
  failure: "failure",
  kept: "not judged",
};

/** @param {Episode} episode */
export function isRunning(episode) {
  return (episode.end_utc_ns ?? null) === null;
}

/**
 * @param {Episode} episode
 * @returns {EpisodeState}
 */
export function episodeState(episode) {
  if (isRunning(episode)) {
    return "running";
  }
  return episode.discarded ? "discarded" : (episode.outcome ?? "kept");
}

/**
 * How long an episode is, or has run at a moment.
 *
 * @param {Episode} episode
 * @param {number | null} nowUtcNs `null`: not known, as in a replay, which has times of its own
 */
export function lengthText({ start_utc_ns: start, end_utc_ns: end }, nowUtcNs) {
  const until = end ?? nowUtcNs;
  return until === null ? "" : clock((until - start) / 1e9);
}

/**
 * "Episode 3 runs · 00:12 · put the cup on the plate".
 *
 * @param {Episode | null} episode
 * @param {number | null} nowUtcNs
 */
export function episodeText(episode, nowUtcNs) {
  if (episode === null) {
    return "No episode yet";
  }
  const { number } = episode;
  const state = isRunning(episode) ? `Episode ${number} runs` : `Last episode ${number}: ${EPISODE_TEXT[episodeState(episode)]}`;
  return [state, lengthText(episode, nowUtcNs), episode.task].filter((part) => part !== "").join(" · ");
}

/** @param {RecordingStatus} recording */
export function countsText({ episodes = 0, episodes_discarded: discarded = 0 }) {
  return `${episodes} kept${discarded > 0 ? `, ${discarded} discarded` : ""}`;
}

/**
 * Whether a status has an episode as an answer said that it is, or a later one. A status may be older than the answer that came before it.
 *
 * @param {Episode} answer
 * @param {Episode | null} episode
 */
export function isAsAnswered(answer, episode) {
  if (episode === null || episode.number < answer.number) {
    return false;
  }
  return episode.number > answer.number || episodeState(episode) === episodeState(answer);
}
