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
 * Posts to the API and returns its answer, `null` if that is empty.
 *
 * @param {string} path such as `/v1/record/start`
 * @param {Record<string, unknown>} [body]
 * @param {number} [timeoutMs] 0: none
 * @returns {Promise<unknown>}
 */
export async function post(path, body = {}, timeoutMs = TIMEOUT_MS) {
  const token = sessionStorage.getItem(TOKEN_KEY) ?? "";
  /** @type {Response} */
  let response;
  try {
    response = await fetch(path, {
      method: "POST",
      headers: { "Authorization": `Bearer ${token}`, "Content-Type": "application/json" },
      body: JSON.stringify(body),
      signal: timeoutMs > 0 ? AbortSignal.timeout(timeoutMs) : null,
    });
  } catch {
    throw new ApiError("unreachable", "the daemon does not answer; nothing is known of what it did");
  }
  const text = await response.text();
  /** @type {unknown} */
  let answer = null;
  try {
    answer = text === "" ? null : JSON.parse(text);
  } catch {
    // An answer that is not JSON comes from something else on this port; the code says enough.
  }
  if (!response.ok) {
    throw errorOf(answer, response.status);
  }
  return answer;
}
