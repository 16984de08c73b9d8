/** Numbers and reasons in words: pure functions. */

/** @typedef {Record<string, number>} Losses by reason */

/** Why a set was not recorded (recorder `SetDrop`). */
const SET_REASONS = /** @type {Record<string, string>} */ ({
  encoder_busy: "too little CPU to encode",
  disk_slow: "the disk is too slow",
  write_failed: "writing failed",
  encode_failed: "an image could not be encoded",
  bad_set: "the set was invalid",
  ended: "the recording was being closed",
});

/** Why a frame was not published (bus `DropReason`). */
const FRAME_REASONS = /** @type {Record<string, string>} */ ({
  device_gap: "did not reach this computer",
  incomplete: "incomplete",
  wrong_size: "could not be decoded",
  device_error: "the device flagged damage",
  out_of_order: "came out of order",
  no_slot: "subscribers held all slots",
  abandoned: "from a driver that hung",
  queue_full: "the next stage was busy",
});

/** @param {Losses} losses */
export function total(losses) {
  return Object.values(losses).reduce((sum, n) => sum + n, 0);
}

/**
 * "12 sets lost (10 the disk is too slow, 2 writing failed)"; empty without losses.
 *
 * @param {"set" | "frame"} noun
 * @param {Losses} losses
 */
export function lossesInWords(noun, losses) {
  const sum = total(losses);
  if (sum === 0) {
    return "";
  }
  const reasons = noun === "set" ? SET_REASONS : FRAME_REASONS;
  const present = Object.entries(losses).filter(([, n]) => n > 0);
  const parts = present
    .sort((a, b) => b[1] - a[1])
    .map(([reason, n]) => `${present.length > 1 ? `${n} ` : ""}${reasons[reason] ?? reason.replaceAll("_", " ")}`);
  return `${sum} ${noun}${sum === 1 ? "" : "s"} lost (${parts.join(", ")})`;
}

/**
 * "5 sets lack front/depth", "7 frames missing in sets (4 front/depth, 3 left/color)"; empty if none is missing.
 *
 * @param {Losses} missing by stream
 */
export function missingInWords(missing) {
  const streams = Object.entries(missing).filter(([, n]) => n > 0);
  if (streams.length <= 1) {
    return streams.map(([stream, n]) => `${n} set${n === 1 ? " lacks" : "s lack"} ${stream}`).join("");
  }
  const parts = streams.sort((a, b) => b[1] - a[1]).map(([stream, n]) => `${n} ${stream}`);
  return `${total(missing)} frames missing in sets (${parts.join(", ")})`;
}

/**
 * @param {Losses[]} all
 * @returns {Losses}
 */
export function sumOf(all) {
  /** @type {Losses} */
  const sum = {};
  for (const losses of all) {
    for (const [reason, n] of Object.entries(losses)) {
      sum[reason] = (sum[reason] ?? 0) + n;
    }
  }
  return sum;
}

/** @param {number} seconds */
export function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  const two = (/** @type {number} */ n) => String(n).padStart(2, "0");
  const minutesAndSeconds = `${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
  return whole >= 3600 ? `${Math.floor(whole / 3600)}:${minutesAndSeconds}` : minutesAndSeconds;
}

/** @param {number} bytes */
export function size(bytes) {
  if (bytes >= 1e12) {
    return `${(bytes / 1e12).toFixed(2)} TB`;
  }
  if (bytes >= 1e9) {
    return `${(bytes / 1e9).toFixed(bytes >= 1e11 ? 0 : 1)} GB`;
  }
  return `${(bytes / 1e6).toFixed(bytes >= 1e7 ? 0 : 1)} MB`;
}

/** @param {number} ms */
export function age(ms) {
  if (ms < 1000) {
    return `${Math.round(Math.max(0, ms))} ms`;
  }
  return ms < 60_000 ? `${(ms / 1000).toFixed(1)} s` : clock(ms / 1000);
}

/**
 * Room on the disk, in minutes while a rate is known.
 *
 * @param {number} freeBytes
 * @param {number | null} secondsLeft
 */
export function disk(freeBytes, secondsLeft) {
  const free = `${size(freeBytes)} free`;
  if (secondsLeft === null) {
    return free;
  }
  const minutes = Math.floor(secondsLeft / 60);
  const left = minutes >= 600 ? `${Math.floor(minutes / 60)} h left` : `${minutes} min left`;
  return `${left}, ${free}`;
}

/**
 * What is known of a pixel, line by line.
 *
 * @param {import("./types.js").PixelAnswer} answer
 * @param {boolean} isDepth whether it was asked of a depth image
 */
export function hoverText(answer, isDepth) {
  const place = `${answer.stream}  (${answer.x}, ${answer.y})`;
  if (answer.depth_m === null) {
    return `${place}\n${isDepth ? "hole" : "no depth here"}`;
  }
  const lines = [place, `${(answer.depth_m * 1000).toFixed(answer.depth_m < 1 ? 1 : 0)} mm`];
  if (answer.xyz_m) {
    const [x, y, z] = answer.xyz_m.map((metres) => metres.toFixed(3));
    lines.push(`x ${x}  y ${y}  z ${z} m`);
  }
  return lines.join("\n");
}
