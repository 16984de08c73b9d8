/** Messages of `/v1/live`, protocol 1: pure functions, no sockets. */

/** @typedef {import("./types.js").Image} Image */
/** @typedef {import("./types.js").Watch} Watch */
/** @typedef {import("./types.js").PixelAnswer} PixelAnswer */
/** @typedef {import("./types.js").Hello} Hello */
/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./types.js").Measure} Measure */

export const PROTOCOL = 1;
export const HEAD_BYTES = 48;
export const CREDITS = 4;
export const MAX_WATCHED = 64;

/** Codes that the server closes the socket with. */
export const CLOSED = Object.freeze({
  MISUNDERSTOOD: 4400,
  DENIED: 4401,
  NOT_SHOWN: 4404,
  NO_TOKEN_IN_TIME: 4408,
  TOO_MANY_PAGES: 4429,
});

const KIND_JPEG = 1;
const KIND_DEPTH = 2;
const BYTES_PER_DEPTH = 2;
const NS_PER_MS = 1e6;
const KNOWN = ["hello", "status", "pixel", "problem", "geometry", "measure", "signals"];

/**
 * Reads a binary message.
 *
 * @param {ArrayBuffer} message
 * @returns {Image}
 */
export function parseImage(message) {
  if (message.byteLength < HEAD_BYTES) {
    throw new RangeError(`an image message has ${message.byteLength} bytes; its head alone has ${HEAD_BYTES}`);
  }
  const head = new DataView(message);
  const protocol = head.getUint16(0, true);
  if (protocol !== PROTOCOL) {
    throw new RangeError(`an image of protocol ${protocol}; this page reads protocol ${PROTOCOL}`);
  }
  const kind = head.getUint8(2);
  if (kind !== KIND_JPEG && kind !== KIND_DEPTH) {
    throw new RangeError(`unknown kind of image: ${kind}`);
  }
  const columns = head.getUint16(8, true);
  const rows = head.getUint16(10, true);
  const payloadBytes = message.byteLength - HEAD_BYTES;
  if (kind === KIND_DEPTH && payloadBytes !== columns * rows * BYTES_PER_DEPTH) {
    throw new RangeError(`a depth image of ${columns}x${rows} has ${payloadBytes} bytes`);
  }
  return {
    kind: kind === KIND_DEPTH ? "depth" : "jpeg",
    index: head.getUint16(4, true),
    step: head.getUint16(6, true),
    columns,
    rows,
    fullColumns: head.getUint16(12, true),
    fullRows: head.getUint16(14, true),
    sequence: head.getBigUint64(16, true),
    captureNs: head.getBigInt64(24, true),
    ageMs: Number(head.getBigInt64(32, true)) / NS_PER_MS,
    unitM: head.getFloat32(40, true),
    watch: head.getUint32(44, true),
    message,
  };
}

/**
 * The depth of an image, without a copy. The head has an even length, so that it is aligned.
 *
 * @param {Image} image
 * @returns {Uint16Array}
 */
export function depthOf(image) {
  return new Uint16Array(image.message, HEAD_BYTES, image.columns * image.rows);
}

/**
 * The JPEG file of an image, without a copy.
 *
 * @param {Image} image
 * @returns {Uint8Array<ArrayBuffer>}
 */
export function jpegOf(image) {
  return new Uint8Array(image.message, HEAD_BYTES);
}

/**
 * @typedef {{hello: Hello} | {status: Status} | {pixel: PixelAnswer} | {problem: {message: string}}
 *   | {geometry: Geometry} | {measure: Measure} | {signals: import("./types.js").SignalsNews}} ServerMessage
 */

/**
 * Reads a text message; `null` for one that a later version of the server may send.
 *
 * @param {string} text
 * @returns {ServerMessage | null}
 */
export function parseText(text) {
  /** @type {unknown} */
  const message = JSON.parse(text);
  if (typeof message !== "object" || message === null) {
    return null;
  }
  return KNOWN.some((key) => key in message) ? /** @type {ServerMessage} */ (message) : null;
}

/** @param {string} token */
export function tokenMessage(token) {
  return JSON.stringify({ token });
}

/** @param {Watch[]} watched */
export function watchMessage(watched) {
  return JSON.stringify({ watch: watched.slice(0, MAX_WATCHED) });
}

export function creditMessage() {
  return JSON.stringify({ credit: 1 });
}

/**
 * @param {number} id
 * @param {import("./types.js").Place} place
 */
export function pixelMessage(id, place) {
  return JSON.stringify({ pixel: { id, stream: place.stream, x: place.x, y: place.y } });
}

/**
 * Asks for what is new of these signals; `null`: none is shown any more.
 *
 * @param {import("./types.js").ShownSignal[] | null} shown
 */
export function signalsMessage(shown) {
  return JSON.stringify({ signals: shown });
}

/**
 * Steers the dataset that this connection shows.
 *
 * @param {string} command
 * @param {Record<string, unknown>} body
 */
export function replayMessage(command, body) {
  return JSON.stringify({ replay: { [command]: body } });
}
