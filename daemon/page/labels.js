/** What stands on the tiles: state, message and numbers. */

import { age, total } from "./words.js";
import { periodMs, tileState } from "./tilestate.js";
import { WALL_HZ } from "./watch.js";

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./types.js").CameraStatus} CameraStatus */

/** Numbers that change ten times a second cannot be read. */
const NUMBERS_EVERY_MS = 500;
/** A shown image that is not replaced by then is said to grow older. */
const AGEING_MS = 600;

/**
 * @typedef {Object} LabelFacts
 * @property {CameraStatus[]} cameras
 * @property {boolean} isLive
 * @property {boolean} isReplay
 * @property {boolean} isPaused
 * @property {number} fastestHz of a replay; Infinity without one
 * @property {string} preparing
 */

export class TileLabels {
  #numbersAt = -Infinity;
  /** @type {Map<string, number>} age of each stream's newest image when it was drawn, ms */
  #ages = new Map();
  #wall;

  /** @param {import("./wall.js").Wall} wall */
  constructor(wall) {
    this.#wall = wall;
  }

  /**
   * @param {Tile} tile
   * @param {number} ageMs
   */
  drawn(tile, ageMs) {
    this.#ages.set(tile.id, ageMs);
  }

  /**
   * @param {LabelFacts} facts
   * @param {number} now ms
   */
  show(facts, now) {
    const isNumbersDue = now - this.#numbersAt >= NUMBERS_EVERY_MS;
    if (isNumbersDue) {
      this.#numbersAt = now;
    }
    for (const camera of facts.cameras) {
      const alone = this.#wall.withoutStream.get(camera.name);
      if (alone !== undefined) {
        this.#label(alone, camera, facts, now, isNumbersDue);
      }
      for (const { id } of camera.streams) {
        const tile = this.#wall.tiles.get(id);
        // A tile that is not watched gets no images, which says nothing about its stream.
        if (tile !== undefined && (tile.isOnScreen || tile === this.#wall.enlarged)) {
          this.#label(tile, camera, facts, now, isNumbersDue);
        }
      }
    }
  }

  /**
   * @param {Tile} tile
   * @param {CameraStatus} camera
   * @param {LabelFacts} facts
   * @param {number} now
   * @param {boolean} isNumbersDue
   */
  #label(tile, camera, facts, now, isNumbersDue) {
    const { state, message } = tileState({
      camera,
      now,
      drawnAt: tile.drawnAt,
      watchedSince: tile.watchedSince,
      periodMs: periodMs(Math.min(this.#wall.rateOf(tile) || WALL_HZ, facts.fastestHz), tile.stream.nominal_hz),
      isLive: facts.isLive,
      isPaused: facts.isPaused,
      preparing: facts.preparing,
    });
    tile.say(state, message, isNumbersDue ? this.#numbers(tile, facts, now) : null);
  }

  /**
   * @param {Tile} tile
   * @param {LabelFacts} facts
   * @param {number} now
   */
  #numbers(tile, facts, now) {
    const rate = `${tile.stream.rate_hz.toFixed(1)} Hz`;
    const lost = `${total(tile.stream.dropped)} lost`;
    // The images of a replay are as old as its dataset.
    if (facts.isReplay) {
      return `${rate} · ${lost}`;
    }
    const drawnAge = this.#ages.get(tile.id);
    const since = now - tile.drawnAt;
    // The tiles of a wall that was built anew have none yet.
    const hasImage = drawnAge !== undefined && tile.drawnAt !== -Infinity;
    const ageText = !hasImage ? "no image" : age(drawnAge + (since > AGEING_MS ? since : 0));
    return `${rate} · ${ageText} · ${lost}`;
  }
}
