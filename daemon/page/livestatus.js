/** The cameras in a status, and the status of the live rig while the connection shows a dataset. */

import { get } from "./api.js";

/** @typedef {import("./types.js").CameraStatus} CameraStatus */
/** @typedef {import("./types.js").Status} Status */

/**
 * Cameras whose images can be seen here: those of this computer, and those of others whose streams come here.
 *
 * @param {Status} status
 * @returns {CameraStatus[]}
 */
export function shownCameras(status) {
  return [...status.cameras, ...(status.hosts?.hosts ?? []).flatMap(({ mirrored }) => mirrored ?? [])];
}

const EVERY_MS = 700;

export class LiveStatus {
  #timer = 0;
  #isWanted = false;
  #onStatus;

  /** @param {(status: Status) => void} onStatus */
  constructor(onStatus) {
    this.#onStatus = onStatus;
  }

  /** @param {boolean} isWanted */
  follow(isWanted) {
    clearTimeout(this.#timer);
    this.#isWanted = isWanted;
    if (isWanted) {
      void this.#ask();
    }
  }

  async #ask() {
    try {
      const status = /** @type {Status} */ (await get("/v1/status"));
      if (this.#isWanted) {
        this.#onStatus(status);
      }
    } catch {
      // The connection says so when the daemon has gone.
    }
    if (this.#isWanted) {
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => void this.#ask(), EVERY_MS);
    }
  }
}
