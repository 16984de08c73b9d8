/** Keys that must be pressed twice: a pure class. */

/** So long after the first press the second one counts. */
export const TWICE_MS = 2000;

export class DoublePress {
  #key = "";
  #at = -Infinity;

  /**
   * @param {string} key
   * @param {number} now ms
   * @returns {boolean} whether this is the second press
   */
  press(key, now) {
    const isSecond = this.#key === key && now - this.#at <= TWICE_MS;
    this.#key = isSecond ? "" : key;
    this.#at = now;
    return isSecond;
  }
}
