/** One depth stream of the 3-D view: its newest depth, the newest colour of its camera, and where both are. */

import { poseOf, samplePoints } from "./cloudscene.js";
import { isKnown } from "./lens.js";
import { depthOf } from "./protocol.js";
import { ImageSlot } from "./slot.js";
import { thinGrid } from "./thinning.js";

/** @typedef {import("./types.js").CameraStatus} CameraStatus */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./cloudgl.js").CloudRenderer} CloudRenderer */
/** @typedef {import("./slot.js").Prepared} Prepared */

/**
 * Points without a newer image turn grey after so long, though their camera works: a computer that draws with its CPU
 * takes images slower than they are made. Those of a camera that is lost turn grey at once and go later.
 */
const STALE_MS = 4000;
const GONE_MS = 8000;

/** @type {[number, number, number][]} as far apart as can be, and none of them grey */
export const TINTS = [
  [1, 0.47, 0.36], [0.36, 0.72, 1], [0.48, 0.92, 0.45], [1, 0.86, 0.3],
  [0.86, 0.53, 1], [0.32, 0.93, 0.85], [1, 0.6, 0.82], [0.85, 0.85, 0.62],
];

/**
 * @typedef {Object} SourceStreams
 * @property {string} id of the depth
 * @property {string} camera
 * @property {string | null} colorId of the images that colour it
 */

/**
 * The depth streams of a rig, each with the images that colour it: those called colour, or else the first others.
 *
 * @param {CameraStatus[]} cameras
 * @param {(format: string) => boolean} isDepth
 * @returns {SourceStreams[]}
 */
export function sourcesOf(cameras, isDepth) {
  return cameras.flatMap(({ name, streams }) => {
    const images = streams.filter(({ samples_hz }) => samples_hz === null || samples_hz === undefined);
    const others = images.filter(({ format }) => !isDepth(format));
    const color = others.find(({ id }) => id.endsWith("/color")) ?? others[0] ?? null;
    return images
      .filter(({ format }) => isDepth(format))
      .map(({ id }) => ({ id, camera: name, colorId: color?.id ?? null }));
  });
}

export class CloudSource {
  isShown = true;
  isStale = false;
  isGone = false;
  #depthSlot;
  #colorSlot;
  /** @type {Prepared | null} */
  #depth = null;
  #hasColor = false;
  #arrivedAt = -Infinity;
  /** @type {import("./cloudgl.js").CloudTextures | null} */
  #textures = null;
  /** @type {Float32Array | null} */
  #rays = null;
  #geometries;

  /**
   * @param {SourceStreams} streams
   * @param {[number, number, number]} tint
   * @param {ReadonlyMap<string, Geometry>} geometries
   * @param {() => void} onPrepared
   */
  constructor(streams, tint, geometries, onPrepared) {
    this.id = streams.id;
    this.camera = streams.camera;
    this.colorId = streams.colorId;
    this.tint = tint;
    this.#geometries = geometries;
    this.#depthSlot = new ImageSlot(onPrepared);
    this.#colorSlot = new ImageSlot(onPrepared);
  }

  /** Its newest depth image, in the form in which the range of the colours reads tiles. */
  get shown() {
    return this.#depth;
  }

  get isOnScreen() {
    return this.isShown && !this.isGone;
  }

  /** Where the depth is; `null` while that is not known. */
  get geometry() {
    const geometry = this.#geometries.get(this.id);
    return geometry !== undefined && isKnown(geometry.intrinsics) ? geometry : null;
  }

  /**
   * Points that its newest image could have.
   *
   * @returns {number}
   */
  get offered() {
    const image = this.#depth?.image;
    return image === undefined || this.geometry === null || !this.isOnScreen ? 0 : image.columns * image.rows;
  }

  /**
   * @param {string} stream its depth or its colour
   * @param {import("./slot.js").Delivery} delivery
   */
  accept(stream, delivery) {
    (stream === this.id ? this.#depthSlot : this.#colorSlot).put(delivery);
  }

  /** Drops images that were not drawn. */
  clear() {
    this.#depthSlot.clear();
    this.#colorSlot.clear();
  }

  /**
   * Forgets what is on the graphics card; `renderer` is `null` if it is gone with its context.
   *
   * @param {CloudRenderer | null} renderer
   */
  release(renderer) {
    if (this.#textures !== null) {
      renderer?.deleteTextures(this.#textures);
    }
    this.#textures = null;
    this.#depth = null;
    this.#hasColor = false;
    this.#arrivedAt = -Infinity;
    this.clear();
  }

  /**
   * Brings the newest images to the graphics card and gives their credit back.
   *
   * @param {CloudRenderer} renderer
   * @returns {boolean} whether there were any
   */
  upload(renderer) {
    const depth = this.#depthSlot.take();
    const color = this.#colorSlot.take();
    if (depth === null && color === null) {
      return false;
    }
    this.#textures ??= renderer.createTextures();
    if (depth !== null && depth.image.kind === "depth") {
      renderer.putDepth(this.#textures, depth.image);
      this.#depth = depth;
      this.#arrivedAt = performance.now();
    }
    if (color !== null && color.bitmap !== null) {
      renderer.putColor(this.#textures, color.bitmap);
      this.#hasColor = true;
      color.bitmap.close();
    }
    depth?.credit();
    color?.credit();
    return true;
  }

  /**
   * Follows its camera and the clock.
   *
   * @param {boolean} isLost whether its camera has no images
   * @param {number} now ms
   * @param {boolean} isPaused whether a replay waits
   * @returns {boolean} whether anything changed
   */
  follow(isLost, now, isPaused) {
    const since = now - this.#arrivedAt;
    const isStale = this.#depth !== null && !isPaused && (isLost || since > STALE_MS);
    const isGone = this.#depth === null || (isStale && since > GONE_MS);
    const hasChanged = isStale !== this.isStale || isGone !== this.isGone;
    this.isStale = isStale;
    this.isGone = isGone;
    return hasChanged;
  }

  /**
   * Its part of a frame; `null` without points.
   *
   * @param {CloudRenderer} renderer
   * @param {number} share of its points that is drawn
   * @returns {import("./cloudgl.js").CloudPoints | null}
   */
  points(renderer, share) {
    const depth = this.geometry;
    if (this.#depth === null || this.#textures === null || depth === null || !this.isOnScreen) {
      return null;
    }
    const { image } = this.#depth;
    this.#rays = renderer.putRays(this.#textures, depth, image) ?? this.#rays;
    const color = this.#geometries.get(this.colorId ?? "");
    return {
      textures: this.#textures,
      depth,
      color: this.#hasColor && color !== undefined && isKnown(color.intrinsics) ? color : null,
      unitM: image.unitM,
      step: image.step,
      columns: image.columns,
      grid: thinGrid(image.columns, image.rows, share),
      tint: this.tint,
      isStale: this.isStale,
    };
  }

  /**
   * Some of its points on the mount.
   *
   * @param {number} limit
   */
  samples(limit) {
    const { geometry } = this;
    if (this.#depth === null || this.#rays === null || geometry === null) {
      return [];
    }
    const { image } = this.#depth;
    return samplePoints(depthOf(image), this.#rays, image.unitM, poseOf(geometry), limit);
  }
}
