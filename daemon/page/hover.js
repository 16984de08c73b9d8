/** What lies under the pointer: depth, place, and where the other cameras see it. */

import { byId, setText } from "./dom.js";
import { pixelAt } from "./layout.js";
import { hoverText } from "./words.js";

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./types.js").PixelAnswer} PixelAnswer */
/** @typedef {import("./types.js").Place} Place */

/** An answer to an old question is replaced so often while the pointer rests: the scene moves. */
const REFRESH_MS = 250;
/** An answer that has not come by then does not come. */
const LOST_MS = 1000;
const OFFSET_PX = 14;

export class Hover {
  #text = byId("hover", HTMLElement);
  /** @type {Place | null} under the pointer */
  #place = null;
  #id = 0;
  /** When the question that waits for its answer was asked; `null` without one. */
  #askedAt = /** @type {number | null} */ (null);
  #timer = 0;
  #tiles;
  #ask;

  /**
   * @param {ReadonlyMap<string, Tile>} tiles
   * @param {(id: number, place: Place) => void} ask
   */
  constructor(tiles, ask) {
    this.#tiles = tiles;
    this.#ask = ask;
    const wall = byId("wall", HTMLElement);
    wall.addEventListener("pointermove", (event) => this.#moved(event));
    wall.addEventListener("pointerdown", (event) => this.#moved(event));
    wall.addEventListener("pointerleave", () => this.hide());
  }

  /** @param {PointerEvent} event */
  #moved(event) {
    const view = event.target instanceof Element ? event.target.closest(".view") : null;
    const section = view?.closest("section");
    const tile = this.#tiles.get(section?.dataset.stream ?? "");
    if (view === null || tile === undefined || tile.shown === null) {
      this.hide();
      return;
    }
    const box = view.getBoundingClientRect();
    const { columns, rows } = tile.fullSize;
    const pixel = pixelAt({ x: event.clientX - box.left, y: event.clientY - box.top }, tile.imageRect, columns, rows);
    if (pixel === null) {
      this.hide();
      return;
    }
    if (this.#place?.stream !== tile.id) {
      this.hide();
    }
    this.#place = { stream: tile.id, x: pixel.x, y: pixel.y };
    this.#follow(event.clientX, event.clientY);
    this.#askNewest();
  }

  /** Asks about the newest place, once the question before is answered. */
  #askNewest() {
    const now = performance.now();
    const isWaiting = this.#askedAt !== null && now - this.#askedAt < LOST_MS;
    if (this.#place === null || isWaiting || document.hidden) {
      return;
    }
    this.#id += 1;
    this.#askedAt = now;
    this.#ask(this.#id, this.#place);
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#askNewest(), LOST_MS + 1);
  }

  /** @param {PixelAnswer} answer */
  answer(answer) {
    if (answer.id !== this.#id) {
      return;
    }
    this.#askedAt = null;
    const place = this.#place;
    if (place === null || place.stream !== answer.stream) {
      return;
    }
    const asked = this.#tiles.get(answer.stream);
    const lines = hoverText(answer, asked?.isDepth ?? true);
    setText(this.#text, lines);
    this.#text.hidden = false;
    for (const tile of this.#tiles.values()) {
      tile.mark(answer.seen.filter(({ stream }) => stream === tile.id && stream !== answer.stream));
    }
    clearTimeout(this.#timer);
    const hasMoved = place.x !== answer.x || place.y !== answer.y;
    this.#timer = setTimeout(() => this.#askNewest(), hasMoved ? 30 : REFRESH_MS);
  }

  hide() {
    clearTimeout(this.#timer);
    this.#place = null;
    this.#askedAt = null;
    this.#text.hidden = true;
    for (const tile of this.#tiles.values()) {
      tile.mark([]);
    }
  }

  /**
   * Beside the pointer, on the side where there is room.
   *
   * @param {number} x
   * @param {number} y
   */
  #follow(x, y) {
    const isRight = x > innerWidth * 0.7;
    const isLow = y > innerHeight * 0.8;
    const { style } = this.#text;
    style.left = isRight ? "auto" : `${x + OFFSET_PX}px`;
    style.right = isRight ? `${innerWidth - x + OFFSET_PX}px` : "auto";
    style.top = isLow ? "auto" : `${y + OFFSET_PX}px`;
    style.bottom = isLow ? `${innerHeight - y + OFFSET_PX}px` : "auto";
  }
}
