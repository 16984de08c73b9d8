/** Draws tiles: each at most once an animation frame, with its newest image. */

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {import("./mixture.js").Mixture} Mixture */

/**
 * @typedef {Object} PainterOptions
 * @property {import("./tile.js").Tables} tables
 * @property {() => {enlarged: Tile | null, mixture: Mixture | null}} enlargement
 * @property {(tile: Tile, ageMs: number) => void} onDrawn
 */

export class Painter {
  /** @type {Set<Tile>} to be drawn in the next animation frame */
  #dirty = new Set();
  #isFrameAsked = false;
  #options;

  /** @param {PainterOptions} options */
  constructor(options) {
    this.#options = options;
  }

  /** @param {Tile} tile */
  redraw(tile) {
    this.#dirty.add(tile);
    if (!this.#isFrameAsked) {
      this.#isFrameAsked = true;
      requestAnimationFrame(() => this.#frame());
    }
  }

  #frame() {
    this.#isFrameAsked = false;
    const { enlarged, mixture } = this.#options.enlargement();
    const isMixtureDirty = mixture !== null && (this.#dirty.has(mixture.below) || this.#dirty.has(mixture.above));
    if (enlarged !== null && isMixtureDirty) {
      this.#dirty.add(enlarged);
    }
    const drawn = [...this.#dirty];
    this.#dirty.clear();
    // All are taken before the first is drawn: a mixture shows the newest image of both.
    const taken = drawn.map((tile) => ({ tile, delivery: tile.takeNewest() }));
    for (const { tile, delivery } of taken) {
      tile.draw(this.#options.tables, tile === enlarged ? mixture : null);
      if (delivery !== null) {
        const sinceReceived = performance.now() - delivery.receivedAt;
        this.#options.onDrawn(tile, delivery.image.ageMs + sinceReceived);
        delivery.credit();
      }
    }
  }
}
