/** How many points are drawn: as many as this computer draws in time. Pure functions, and a controller. */

/** The time of a frame that is aimed at: 12 frames a second follow a hand. */
export const TARGET_MS = 80;
export const FEWEST_POINTS = 5000;
export const MOST_POINTS = 300_000;
const FIRST_POINTS = 60_000;
/** Within this of the target nothing is changed: a cloud whose grain changes all the time flickers. */
const TOLERANCE = 0.2;
const SLOWEST_CHANGE = 0.5;
const FASTEST_CHANGE = 1.3;
/** One frame that took long (a collection of garbage, another program) is no reason. */
const FRAMES = 3;

/** Wide enough to reach the points that are wanted, and no wider. */
export const SMALL_WIDTH = 320;
export const LARGE_WIDTH = 640;
const SMALL_PIXELS = SMALL_WIDTH * 180;

export class Thinning {
  /** Points that the next frame may have. */
  budget = FIRST_POINTS;
  #limit = MOST_POINTS;
  #isAutomatic = true;
  /** @type {number[]} time for a point of the last frames, ms */
  #costs = [];

  /** @param {number | null} points a fixed number; `null`: as many as the computer draws in time */
  setLimit(points) {
    this.#isAutomatic = points === null;
    this.#limit = points ?? MOST_POINTS;
    this.budget = this.#isAutomatic ? Math.min(this.budget, this.#limit) : this.#limit;
    this.#costs = [];
  }


  /**
   * @param {number} ms that a frame took
   * @param {number} points that it had
   */
  drawn(ms, points) {
    if (!this.#isAutomatic || points === 0) {
      return;
    }
    this.#costs.push(ms / points);
    if (this.#costs.length < FRAMES) {
      return;
    }
    const cost = [...this.#costs].sort((a, b) => a - b)[Math.floor(FRAMES / 2)];
    this.#costs = [];
    const expected = cost * Math.min(points, this.budget);
    if (Math.abs(expected - TARGET_MS) <= TOLERANCE * TARGET_MS) {
      return;
    }
    const wanted = TARGET_MS / expected;
    const change = Math.min(FASTEST_CHANGE, Math.max(SLOWEST_CHANGE, wanted));
    // A scene with fewer points than are allowed does not say what more would cost.
    const from = change > 1 ? this.budget : Math.min(points, this.budget);
    this.budget = Math.round(Math.min(this.#limit, Math.max(FEWEST_POINTS, from * change)));
  }
}

/**
 * The grid of pixels that is drawn of an image: evenly thinned in both directions.
 *
 * @param {number} columns
 * @param {number} rows
 * @param {number} share of the pixels, 0 to 1
 * @returns {{columns: number, rows: number}}
 */
export function thinGrid(columns, rows, share) {
  const along = Math.sqrt(Math.min(1, Math.max(0, share)));
  return {
    columns: Math.max(1, Math.floor(columns * along)),
    rows: Math.max(1, Math.floor(rows * along)),
  };
}

/**
 * How wide the depth images are asked for.
 *
 * @param {number} limit of points
 * @param {number} images
 */
export function cloudWidth(limit, images) {
  return limit > 1.5 * SMALL_PIXELS * images ? LARGE_WIDTH : SMALL_WIDTH;
}
