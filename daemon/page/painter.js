/** Draws tiles: each at most once an animation frame, with its newest image. */

/** @typedef {import("./tile.js").Tile} Tile */
/** @typedef {{below: Tile, above: Tile, share: number}} BlendOfTiles */

/**
 * @typedef {Object} PainterOptions
 * @property {import("./tile.js").Tables} tables
 * @property {() => {enlarged: Tile | null, blend: BlendOfTiles | null}} enlargement
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
    const { enlarged, blend } = this.#options.enlargement();
    const isBlendDirty = blend !== null && (this.#dirty.has(blend.below) || this.#dirty.has(blend.above));
    if (enlarged !== null && isBlendDirty) {
      this.#dirty.add(enlarged);
    }
    const drawn = [...this.#dirty];
    this.#dirty.clear();
    // All are taken before the first is drawn: a blend shows the newest image of both.
    const taken = drawn.map((tile) => ({ tile, delivery: tile.takeNewest() }));
    for (const { tile, delivery } of taken) {
      tile.draw(this.#options.tables, tile === enlarged ? blend : null);
      if (delivery !== null) {
        const sinceReceived = performance.now() - delivery.receivedAt;
        this.#options.onDrawn(tile, delivery.image.ageMs + sinceReceived);
        delivery.credit();
      }
    }
  }
}
