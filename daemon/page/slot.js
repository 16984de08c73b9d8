/** The newest image of a stream, decoded: whatever is older is never drawn, and its credit goes back at once. */

import { jpegOf } from "./protocol.js";

/** @typedef {import("./types.js").Image} Image */
/** @typedef {{image: Image, receivedAt: number, credit: () => void}} Delivery */
/** @typedef {Delivery & {bitmap: ImageBitmap | null}} Prepared */

export class ImageSlot {
  /** @type {Delivery | null} the newest image, while an older one is decoded */
  #waiting = null;
  #isDecoding = false;
  /** @type {Prepared | null} decoded, and not drawn */
  #prepared = null;
  #onPrepared;

  /** @param {() => void} onPrepared an image waits to be drawn */
  constructor(onPrepared) {
    this.#onPrepared = onPrepared;
  }

  /** @param {Delivery} delivery */
  put(delivery) {
    this.#waiting?.credit();
    this.#waiting = delivery;
    void this.#decode();
  }

  /**
   * Takes the image out to be drawn; the caller gives its credit. `null` without a new one.
   *
   * @returns {Prepared | null}
   */
  take() {
    const prepared = this.#prepared;
    this.#prepared = null;
    return prepared;
  }

  /** Drops what was not drawn, so that nothing old is shown when the tab comes back. */
  clear() {
    this.#waiting?.credit();
    this.#waiting = null;
    this.#release(this.take());
  }

  async #decode() {
    while (this.#waiting !== null && !this.#isDecoding) {
      const delivery = this.#waiting;
      this.#waiting = null;
      this.#isDecoding = true;
      /** @type {ImageBitmap | null} */
      let bitmap = null;
      try {
        if (delivery.image.kind === "jpeg") {
          bitmap = await createImageBitmap(new Blob([jpegOf(delivery.image)], { type: "image/jpeg" }));
        }
        this.#release(this.#prepared);
        this.#prepared = { ...delivery, bitmap };
        this.#onPrepared();
      } catch {
        // A damaged image is skipped; the tile turns stale if no better one comes.
        delivery.credit();
      } finally {
        this.#isDecoding = false;
      }
    }
  }

  /** @param {Prepared | null} prepared */
  #release(prepared) {
    prepared?.bitmap?.close();
    prepared?.credit();
  }
}
