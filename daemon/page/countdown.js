/** The countdown before a recording. */

const SECOND_MS = 1000;

export class Countdown {
  #timer = 0;
  #left = 0;
  #onSecond;
  #onDone;

  /**
   * @param {(left: number) => void} onSecond each whole second that is left
   * @param {() => void} onDone
   */
  constructor(onSecond, onDone) {
    this.#onSecond = onSecond;
    this.#onDone = onDone;
  }

  /** Seconds that are left; 0 when it does not run. */
  get left() {
    return this.#left;
  }

  get isRunning() {
    return this.#left > 0;
  }

  /** @param {number} seconds */
  start(seconds) {
    this.cancel();
    this.#left = seconds;
    this.#step();
  }

  /** @returns {boolean} whether it was running */
  cancel() {
    clearTimeout(this.#timer);
    const wasRunning = this.isRunning;
    this.#left = 0;
    return wasRunning;
  }

  #step() {
    if (this.#left <= 0) {
      this.#onDone();
      return;
    }
    this.#onSecond(this.#left);
    this.#timer = setTimeout(() => {
      this.#left -= 1;
      this.#step();
    }, SECOND_MS);
  }
}
