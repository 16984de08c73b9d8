/** How far apart the streams of a set are: pure functions. */

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").StreamStatus} StreamStatus */
/** @typedef {"good" | "wide" | "out" | "none"} SkewState */

/**
 * @typedef {Object} StreamSkew
 * @property {string} stream
 * @property {number | null} medianMs `null`: in no set yet
 * @property {number | null} p95Ms
 * @property {number} windowMs how far from the tick of its set a frame may lie
 * @property {SkewState} state
 *
 * @typedef {{stream: string, ms: number | null, state: SkewState}} PairSkew
 */

/** A frame is in a set if it lies within half its period of the tick and this (daemon/src/sets.rs). */
const TOLERANCE_MS = 1;
/** Beyond this share of the window a skew is wide. */
const WIDE = 0.5;
/** The stream that stands for its camera among cameras. */
const FIRST = ["color", "left", "infrared", "infrared_left", "ir"];

/** @param {StreamStatus} stream */
export function isImageStream(stream) {
  return stream.samples_hz === null || stream.samples_hz === undefined;
}

/** @param {number} nominalHz */
export function windowMs(nominalHz) {
  return nominalHz > 0 ? 500 / nominalHz + TOLERANCE_MS : Infinity;
}

/**
 * @param {number | null} ms
 * @param {number} window
 * @returns {SkewState}
 */
export function skewState(ms, window) {
  if (ms === null) {
    return "none";
  }
  const size = Math.abs(ms);
  return size > window ? "out" : size > WIDE * window ? "wide" : "good";
}

/**
 * @param {Status} status
 * @returns {StreamSkew[]}
 */
export function streamSkews(status) {
  const known = new Map((status.sets.skews ?? []).map((skew) => [skew.stream, skew]));
  const streams = status.cameras.flatMap((camera) => camera.streams.filter(isImageStream));
  return streams.map(({ id, nominal_hz }) => {
    const skew = known.get(id);
    const window = windowMs(nominal_hz);
    const median = skew?.median_ms ?? null;
    // Cameras that run free wander through their window, which is no fault; its end and a lasting offset are worth a look.
    const isOut = skew !== undefined && skew.p95_ms > window;
    return {
      stream: id,
      medianMs: median,
      p95Ms: skew?.p95_ms ?? null,
      windowMs: window,
      state: isOut ? "out" : skewState(median, window),
    };
  });
}

/**
 * The stream that stands for a camera: its colour images if it has some.
 *
 * @param {string} camera
 * @param {string[]} ids of its image streams
 * @returns {string | undefined}
 */
export function preferredStream(camera, ids) {
  return FIRST.map((name) => `${camera}/${name}`).find((id) => ids.includes(id)) ?? ids[0];
}

/**
 * @param {Status} status
 * @returns {string[]} one stream of each camera
 */
export function streamOfEach(status) {
  return status.cameras.flatMap(({ name, streams }) => {
    const ids = streams.filter(isImageStream).map(({ id }) => id);
    return preferredStream(name, ids) ?? [];
  });
}

/**
 * Median distance of each of the streams from each other, row by row. It is measured against the wider of both windows.
 *
 * @param {StreamSkew[]} skews
 * @param {string[]} streams
 * @returns {PairSkew[][]}
 */
export function pairSkews(skews, streams) {
  const of = new Map(skews.map((skew) => [skew.stream, skew]));
  return streams.map((a) =>
    streams.map((b) => {
      const one = of.get(a);
      const other = of.get(b);
      const from = one?.medianMs ?? null;
      const to = other?.medianMs ?? null;
      const ms = from === null || to === null ? null : to - from;
      const window = Math.max(one?.windowMs ?? 0, other?.windowMs ?? 0);
      return { stream: b, ms, state: skewState(ms, window) };
    }),
  );
}

/** @param {number | null} ms */
export function signedMs(ms) {
  if (ms === null) {
    return "–";
  }
  const rounded = ms.toFixed(1);
  return Number(rounded) > 0 ? `+${rounded}` : rounded === "-0.0" ? "0.0" : rounded;
}
