/** The token, and the REST API `/v1`. */

const TOKEN_KEY = "depthrig-token";
const TIMEOUT_MS = 8000;

/** An error that the API answers with. */
export class ApiError extends Error {
  /**
   * @param {string} kind
   * @param {string} message
   */
  constructor(kind, message) {
    super(message);
    this.kind = kind;
  }
}

/**
 * The token out of `#token=`, or the one this tab was opened with. It leaves the address at once, so that it is in
 * no bookmark and on no screenshot.
 *
 * @returns {string | null}
 */
export function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given !== null) {
    history.replaceState(null, "", location.pathname + location.search);
    sessionStorage.setItem(TOKEN_KEY, given);
  }
  return sessionStorage.getItem(TOKEN_KEY);
}

/**
 * @param {unknown} answer
 * @param {number} code
 */
function errorOf(answer, code) {
  const described = /** @type {{error?: {kind?: string, message?: string}} | null} */ (answer);
  const kind = described?.error?.kind ?? "other";
  const message = described?.error?.message ?? `the daemon answered ${code}`;
  return new ApiError(kind, message);
}

/**
 * @typedef {Object} Call
 * @property {"GET" | "POST"} method
 * @property {Record<string, unknown>} [body]
 * @property {AbortSignal | null} signal
 */

/**
 * Calls the API; an answer that is an error is thrown.
 *
 * @param {string} path such as `/v1/record/start`
 * @param {Call} call
 * @returns {Promise<Response>}
 */
async function ask(path, { method, body, signal }) {
  /** @type {Record<string, string>} */
  const headers = { Authorization: `Bearer ${sessionStorage.getItem(TOKEN_KEY) ?? ""}` };
  if (body !== undefined) {
    headers["Content-Type"] = "application/json";
  }
  /** @type {Response} */
  let response;
  try {
    response = await fetch(path, { method, headers, body: body === undefined ? null : JSON.stringify(body), signal });
  } catch {
    const unknown = method === "POST" ? "; nothing is known of what it did" : "";
    throw new ApiError("unreachable", `the daemon does not answer${unknown}`);
  }
  if (!response.ok) {
    throw errorOf(await parse(response), response.status);
  }
  return response;
}

/**
 * @param {Response} response
 * @returns {Promise<unknown>} `null` without an answer in JSON
 */
async function parse(response) {
  try {
    const text = await response.text();
    return text === "" ? null : JSON.parse(text);
  } catch {
    // An answer that is not JSON comes from something else on this port; the code says enough.
    return null;
  }
}

/** @param {number} timeoutMs 0: none */
function timeout(timeoutMs) {
  return timeoutMs > 0 ? AbortSignal.timeout(timeoutMs) : null;
}

/**
 * Posts to the API and returns its answer, `null` if that is empty.
 *
 * @param {string} path
 * @param {Record<string, unknown>} [body]
 * @param {number} [timeoutMs] 0: none
 * @returns {Promise<unknown>}
 */
export async function post(path, body = {}, timeoutMs = TIMEOUT_MS) {
  return parse(await ask(path, { method: "POST", body, signal: timeout(timeoutMs) }));
}

/**
 * @param {string} path
 * @param {number} [timeoutMs] 0: none
 * @returns {Promise<unknown>}
 */
export async function get(path, timeoutMs = TIMEOUT_MS) {
  return parse(await ask(path, { method: "GET", signal: timeout(timeoutMs) }));
}

/**
 * @param {string} path
 * @returns {Promise<Blob>}
 */
export async function getBlob(path) {
  return (await ask(path, { method: "GET", signal: timeout(TIMEOUT_MS) })).blob();
}

/**
 * An answer that goes on until it is aborted.
 *
 * @param {string} path
 * @param {AbortSignal} signal
 * @returns {Promise<ReadableStream<Uint8Array> | null>}
 */
export async function getStream(path, signal) {
  return (await ask(path, { method: "GET", signal })).body;
}

/** @param {unknown} error */
export function messageOf(error) {
  return error instanceof Error ? error.message : String(error);
}
