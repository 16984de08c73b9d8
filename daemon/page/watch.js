/** Which streams are asked for, how large and how often: a pure function. */

/** @typedef {import("./types.js").Watch} Watch */
/** @typedef {{id: string, isOnScreen: boolean}} Watchable */

export const WALL_WIDTH = 640;
export const WALL_HZ = 10;
/** Beside an enlarged image the others are small. */
export const STRIP_WIDTH = 320;
export const STRIP_HZ = 5;
export const FULL_WIDTH = 0;

/**
 * @template {Watchable} T
 * @param {Iterable<T>} tiles
 * @param {T | null} enlarged
 * @param {{below: T, above: T} | null} mixture what the enlarged image is made of
 * @param {boolean} [isMeasured] whether the numbers of the enlarged stream are shown
 * @returns {Watch[]}
 */
export function watchOf(tiles, enlarged, mixture, isMeasured = false) {
  /** @type {Watch[]} */
  const watched = [];
  for (const tile of tiles) {
    const isFull = tile === enlarged || tile === mixture?.below || tile === mixture?.above;
    if (isFull) {
      const measured = isMeasured && tile === enlarged ? { measure: true } : {};
      watched.push({ stream: tile.id, width: FULL_WIDTH, rate_hz: WALL_HZ, ...measured });
    } else if (tile.isOnScreen) {
      const width = enlarged === null ? WALL_WIDTH : STRIP_WIDTH;
      const rate = enlarged === null ? WALL_HZ : STRIP_HZ;
      watched.push({ stream: tile.id, width, rate_hz: rate });
    }
  }
  return watched;
}

/** What was asked of the server last, and what its images answer. */
export class WatchList {
  /** @type {Watch[]} */
  #watched = [];
  /** The list as it was sent on this connection; empty before the first. */
  #sentText = "";
  #number = 0;
  #send;

  /** @param {(watched: Watch[]) => number} send returns the number of the message; 0: not sent */
  constructor(send) {
    this.#send = send;
  }

  /**
   * Asks for these streams, if they are not what was asked for already.
   *
   * @param {Watch[]} watched
   * @returns {string[]} streams that were not watched before
   */
  ask(watched) {
    const text = JSON.stringify(watched);
    const number = text === this.#sentText ? 0 : this.#send(watched);
    if (number === 0) {
      return [];
    }
    const before = this.#sentText === "" ? [] : this.#watched.map(({ stream }) => stream);
    this.#watched = watched;
    this.#sentText = text;
    this.#number = number;
    return watched.map(({ stream }) => stream).filter((stream) => !before.includes(stream));
  }

  /** A new connection knows nothing of what was asked on the one before. */
  forget() {
    this.#sentText = "";
    this.#number = 0;
  }

  /**
   * The stream of an image; `null` for one that answers an earlier list.
   *
   * @param {{watch: number, index: number}} image
   * @returns {string | null}
   */
  streamOf(image) {
    return image.watch === this.#number ? (this.#watched[image.index]?.stream ?? null) : null;
  }

  /** @param {string} stream */
  rateOf(stream) {
    return this.#watched.find((watch) => watch.stream === stream)?.rate_hz ?? 0;
  }
}
