/** The status of the live rig while the connection shows a dataset. */

import { get } from "./api.js";

/** @typedef {import("./types.js").Status} Status */

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
