/** The wall of tiles: which there are, which are watched, which is enlarged, and when they are drawn. */

import { announce, byId, make } from "./dom.js";
import { fitWall } from "./fit.js";
import { Painter } from "./painter.js";
import { Tile, tileWithoutStream } from "./tile.js";
import { WatchList, watchOf } from "./watch.js";

/** @typedef {import("./types.js").CameraStatus} CameraStatus */
/** @typedef {import("./types.js").Watch} Watch */
/** @typedef {import("./types.js").Image} Image */

/**
 * @typedef {Object} WallOptions
 * @property {(watched: Watch[]) => number} watch sends a watch list and returns its number; 0: not sent
 * @property {import("./tile.js").Tables} tables
 * @property {(enlarged: Tile | null) => void} onEnlarged
 * @property {(tile: Tile) => import("./mixture.js").Mixture | null} mixtureOf
 * @property {(tile: Tile, ageMs: number) => void} onDrawn
 * @property {() => boolean} isMeasured whether the numbers of the enlarged stream are shown
 * @property {() => Watch[] | null} watchInstead what a view that takes the place of the wall needs; `null` without one
 * @property {(stream: string, delivery: import("./slot.js").Delivery) => boolean} takeInstead takes an image for it
 */

export class Wall {
  /** @type {Map<string, Tile>} */
  tiles = new Map();
  /** @type {Map<string, Tile>} of cameras whose streams are not known, such as one that is not plugged in; by name */
  withoutStream = new Map();
  /** @type {Tile | null} */
  enlarged = null;
  #wall = byId("wall", HTMLElement);
  #cameras = byId("cameras", HTMLElement);
  #back = byId("back", HTMLButtonElement);
  #options;
  #watchList;
  #painter;
  #isWatchAsked = false;
  /** The streams that the tiles were built for. */
  #built = "";
  #observer = new IntersectionObserver((entries) => this.#seen(entries));

  /** @param {WallOptions} options */
  constructor(options) {
    this.#options = options;
    this.#watchList = new WatchList(options.watch);
    this.#painter = new Painter({
      tables: options.tables,
      enlargement: () => ({ enlarged: this.enlarged, mixture: this.#mixture() }),
      onDrawn: options.onDrawn,
    });
    new ResizeObserver(() => this.#fit()).observe(this.#wall);
    document.addEventListener("visibilitychange", () => this.#visibilityChanged());
    this.#back.addEventListener("click", () => this.enlarge(null));
    this.#cameras.addEventListener("click", (event) => this.#clicked(event));
  }

  /**
   * Builds the tiles, again if the rig's streams have changed.
   *
   * @param {CameraStatus[]} cameras
   */
  build(cameras) {
    const images = cameras.map((camera) => ({
      name: camera.name,
      hasStreams: camera.streams.length > 0,
      streams: camera.streams.filter((stream) => stream.samples_hz === null || stream.samples_hz === undefined),
    }));
    const built = JSON.stringify(
      images.map(({ name, streams }) => [name, streams.map((s) => [s.id, s.format, s.width, s.height])]),
    );
    if (built === this.#built) {
      return;
    }
    this.#built = built;
    const enlargedId = this.enlarged?.id;
    this.enlarge(null);
    this.#observer.disconnect();
    for (const tile of this.tiles.values()) {
      tile.dropUndrawn();
    }
    this.tiles.clear();
    this.withoutStream.clear();
    this.#cameras.replaceChildren();
    for (const { name, hasStreams, streams } of images) {
      const group = make("div", "camera");
      for (const stream of streams) {
        const tile = new Tile(stream, name, () => this.#prepared(tile));
        this.tiles.set(stream.id, tile);
        group.append(tile.element);
        this.#observer.observe(tile.element);
      }
      if (!hasStreams) {
        const tile = tileWithoutStream(name);
        this.withoutStream.set(name, tile);
        group.append(tile.element);
      }
      if (group.childElementCount > 0) {
        this.#cameras.append(group);
      }
    }
    this.#fit();
    this.enlarge(this.tiles.get(enlargedId ?? "") ?? null);
  }

  /**
   * @param {Image} image
   * @param {() => void} credit
   */
  accept(image, credit) {
    const stream = document.hidden ? null : this.#watchList.streamOf(image);
    const delivery = { image, receivedAt: performance.now(), credit };
    if (stream !== null && this.#options.takeInstead(stream, delivery)) {
      return;
    }
    const tile = this.tiles.get(stream ?? "");
    if (tile === undefined) {
      credit();
      return;
    }
    tile.accept(delivery);
  }

  /** Forgets what was asked of an earlier connection and asks again. */
  reconnect() {
    for (const tile of this.tiles.values()) {
      tile.dropUndrawn();
    }
    this.#watchList.forget();
    this.askWatch();
  }

  /** Takes every tile away: what comes next are the images of something else. */
  clear() {
    this.build([]);
    this.#built = "";
  }

  /** Asks for what is visible, once for all changes of this moment. */
  askWatch() {
    if (!this.#isWatchAsked) {
      this.#isWatchAsked = true;
      queueMicrotask(() => {
        this.#isWatchAsked = false;
        this.#watch();
      });
    }
  }

  #watch() {
    const wanted = () => watchOf(this.tiles.values(), this.enlarged, this.#mixture(), this.#options.isMeasured());
    const shown = this.#options.watchInstead() ?? wanted();
    const watched = document.hidden ? [] : shown;
    const now = performance.now();
    for (const stream of this.#watchList.ask(watched)) {
      const tile = this.tiles.get(stream);
      if (tile !== undefined) {
        tile.watchedSince = now;
      }
    }
  }

  #mixture() {
    return this.enlarged === null ? null : this.#options.mixtureOf(this.enlarged);
  }

  /** @param {Tile} tile */
  rateOf(tile) {
    return this.#watchList.rateOf(tile.id);
  }

  /** @param {Tile} tile */
  #prepared(tile) {
    if (document.hidden || !this.tiles.has(tile.id)) {
      tile.dropUndrawn();
      return;
    }
    this.#painter.redraw(tile);
  }

  /** @param {(tile: Tile) => boolean} isMeant */
  redrawAll(isMeant) {
    for (const tile of this.tiles.values()) {
      if (isMeant(tile)) {
        this.#painter.redraw(tile);
      }
    }
  }

  /** @param {IntersectionObserverEntry[]} entries */
  #seen(entries) {
    for (const entry of entries) {
      const id = entry.target instanceof HTMLElement ? entry.target.dataset.stream : undefined;
      const tile = this.tiles.get(id ?? "");
      if (tile !== undefined) {
        tile.isOnScreen = entry.isIntersecting;
      }
    }
    this.askWatch();
  }

  #visibilityChanged() {
    for (const tile of this.tiles.values()) {
      tile.dropUndrawn();
    }
    this.askWatch();
  }

  /** @param {MouseEvent} event */
  #clicked(event) {
    const element = event.target instanceof Element ? event.target.closest("section.tile") : null;
    const id = element instanceof HTMLElement ? element.dataset.stream : undefined;
    const tile = this.tiles.get(id ?? "");
    if (tile !== undefined && tile !== this.enlarged) {
      this.enlarge(tile);
    }
  }

  /** @param {Tile | null} tile `null`: back to the wall */
  enlarge(tile) {
    const before = this.enlarged;
    if (tile === before) {
      return;
    }
    this.enlarged = tile;
    before?.element.classList.remove("enlarged");
    tile?.element.classList.add("enlarged");
    this.#wall.classList.toggle("has-enlarged", tile !== null);
    this.#back.hidden = tile === null;
    this.#options.onEnlarged(tile);
    this.redrawAll((other) => other === before || other === tile);
    (tile ?? before)?.element.focus({ preventScroll: true });
    this.#fit();
    this.askWatch();
    announce(tile === null ? "All streams" : `${tile.id} enlarged`);
  }

  /**
   * Enlarges the n-th camera; its next stream if it is enlarged already.
   *
   * @param {number} n from 1
   * @returns {boolean} whether there is one
   */
  enlargeCamera(n) {
    const names = [...new Set([...this.tiles.values()].map((tile) => tile.camera))];
    const own = [...this.tiles.values()].filter((tile) => tile.camera === names[n - 1]);
    if (own.length > 0) {
      const index = this.enlarged === null ? -1 : own.indexOf(this.enlarged);
      this.enlarge(own[(index + 1) % own.length]);
    }
    return own.length > 0;
  }

  #fit() {
    fitWall(this.#wall, this.#cameras, [...this.tiles.values(), ...this.withoutStream.values()]);
  }
}
