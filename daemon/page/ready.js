/** Whether the rig is ready to record, in one line: a pure function. */

import { isImageStream } from "./skew.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").StreamStatus} StreamStatus */
/** @typedef {import("./paneltypes.js").DoctorReport} DoctorReport */
/** @typedef {{state: "go" | "check" | "no-go", text: string}} Readiness */

const FEW_MINUTES = 5;
const SHORT_MINUTES = 30;
const SILENT_MS = 1000;
const SILENT_PERIODS = 5;
const NAMED = 3;

/** @param {StreamStatus} stream */
function isSilent(stream) {
  const period = 1000 / Math.max(0.1, stream.nominal_hz);
  return stream.last_frame_age_ms === null || stream.last_frame_age_ms > Math.max(SILENT_MS, SILENT_PERIODS * period);
}

/** @param {string[]} names */
function some(names) {
  const more = names.length - NAMED;
  return names.slice(0, NAMED).join(", ") + (more > 0 ? ` and ${more} more` : "");
}

/**
 * @param {number} n
 * @param {string} noun
 */
function counted(n, noun) {
  return n === 0 ? "" : `${n} ${noun}${n === 1 ? "" : "s"}`;
}

/**
 * @param {Status} status
 * @param {DoctorReport | null} doctor `null`: not asked yet
 * @returns {Readiness}
 */
export function readiness(status, doctor) {
  /** @type {string[]} */
  const bad = [];
  /** @type {string[]} */
  const odd = [];
  /** @type {string[]} */
  const good = [];
  streams(status, { bad, odd, good });
  signals(status, { bad });
  computers(status, { bad, good });
  room(status, doctor, { bad, odd, good });
  spread(status, { odd, good });
  if (doctor !== null) {
    const errors = doctor.findings.filter(({ severity }) => severity === "error").length;
    const warnings = doctor.findings.filter(({ severity }) => severity === "warning").length;
    const list = errors > 0 ? bad : warnings > 0 ? odd : good;
    const counts = [counted(errors, "error"), counted(warnings, "warning")].filter(Boolean).join(" and ");
    list.push(counts === "" ? "doctor found nothing" : `doctor has ${counts} (D)`);
  }
  if (bad.length > 0) {
    return { state: "no-go", text: `No-go: ${[...bad, ...odd].join("; ")}` };
  }
  if (odd.length > 0) {
    return { state: "check", text: `Check: ${odd.join("; ")}` };
  }
  return { state: "go", text: `Go: ${good.join(", ")}${doctor === null ? "; doctor was not asked (D)" : ""}` };
}

/**
 * @param {Status} status
 * @param {{bad: string[], odd: string[], good: string[]}} lists
 */
function streams(status, { bad, odd, good }) {
  const down = status.cameras.filter(({ state }) => state !== "streaming" && state !== "stalled");
  if (down.length > 0) {
    bad.push(`${some(down.map(({ name, state }) => `${name} (${state})`))}: no images`);
  }
  const running = status.cameras.filter((camera) => !down.includes(camera));
  const images = running.flatMap((camera) => camera.streams.filter(isImageStream));
  const silent = images.filter(isSilent);
  if (silent.length > 0) {
    bad.push(`${some(silent.map(({ id }) => id))}: no images`);
  }
  if (status.preparing && status.preparing.error === null) {
    odd.push("the simulated scenes are still rendered");
  }
  good.push(`${images.length - silent.length} streams`);
}

/**
 * @param {Status} status
 * @param {{bad: string[]}} lists
 */
function signals(status, { bad }) {
  const faults = (status.signals ?? []).filter(({ required, state }) => required && state !== "live");
  if (faults.length > 0) {
    bad.push(`${some(faults.map(({ signal, state }) => `${signal} (${state})`))}: no samples (I)`);
  }
}

/**
 * The clock of the session, the other computers of the rig, and the program for ROS 2.
 *
 * @param {Status} status
 * @param {{bad: string[], good: string[]}} lists
 */
function computers(status, { bad, good }) {
  const { link } = status;
  if (link && link.state === "unkeyed") {
    bad.push(`${link.recorder ?? "the session"} has not given the key of its clock yet`);
  } else if (link && link.state !== "own" && link.state !== "live") {
    bad.push(`the clock of ${link.recorder ?? "the session"} does not answer`);
  }
  if (status.ros2 && status.ros2.pid === null) {
    bad.push(`ROS 2: ${status.ros2.why ?? "it does not run"}`);
  }
  const hosts = status.hosts?.hosts ?? [];
  for (const { host, state, why, cameras, streaming, has_clock } of hosts) {
    if (state !== "connected") {
      bad.push(`${host} (${state}): ${why ?? ""}`);
    } else if (streaming < cameras) {
      bad.push(`${host}: ${streaming} of ${counted(cameras, "camera")}`);
    } else if (!has_clock) {
      bad.push(`${host}: its clock is not known yet`);
    }
  }
  const connected = hosts.filter(({ state }) => state === "connected");
  if (connected.length > 0) {
    good.push(`with ${some(connected.map(({ host }) => host))}`);
  }
}

/**
 * @param {Status} status
 * @param {DoctorReport | null} doctor
 * @param {{bad: string[], odd: string[], good: string[]}} lists
 */
function room(status, doctor, { bad, odd, good }) {
  const seconds = status.recording?.disk_seconds_left ?? null;
  const minutes = seconds === null ? (doctor?.disk.minutes_left ?? null) : seconds / 60;
  if (minutes === null) {
    return;
  }
  const list = minutes < FEW_MINUTES ? bad : minutes < SHORT_MINUTES ? odd : good;
  list.push(minutes >= 600 ? `${Math.floor(minutes / 60)} h on the disk` : `${Math.floor(minutes)} min on the disk`);
}

/**
 * @param {Status} status
 * @param {{odd: string[], good: string[]}} lists
 */
function spread(status, { odd, good }) {
  const { sets } = status;
  if (sets.sent === 0) {
    return;
  }
  const rates = status.cameras.flatMap((camera) => camera.streams.filter(isImageStream).map((s) => s.nominal_hz));
  const slowest = 1000 / Math.max(0.1, Math.min(...rates));
  const typical = sets.spread_p95_ms ?? sets.spread_p50_ms;
  const text = `sets within ${typical.toFixed(1)} ms`;
  if (typical > slowest + 2) {
    odd.push(`${text}, more than a frame (Y)`);
  } else {
    good.push(text);
  }
}
