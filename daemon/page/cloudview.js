/** The 3-D view: the fused points of all cameras, shown instead of the wall. */

import { CloudBar } from "./cloudbar.js";
import { CloudRenderer } from "./cloudgl.js";
import { LOST, NO_WEBGL, cloudHint } from "./cloudhints.js";
import { CloudInput } from "./cloudinput.js";
import { CloudLabels } from "./cloudlabels.js";
import { floorLines, frustumLines, poseOf, upOf } from "./cloudscene.js";
import { CloudSource, TINTS, sourcesOf } from "./cloudsource.js";
import { announce, byId, setText } from "./dom.js";
import { shownCameras } from "./livestatus.js";
import { dot, multiply } from "./matrix.js";
import { home, projectionMatrix, quantile, viewMatrix } from "./orbit.js";
import { SMALL_WIDTH, Thinning, cloudWidth } from "./thinning.js";
import { isDepthFormat } from "./tile.js";
import { STALE_MS, periodMs } from "./tilestate.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./types.js").Watch} Watch */
/** @typedef {import("./orbit.js").Orbit} Orbit */

const FEW_CAMERAS = 4;
const FEW_HZ = 10;
const MANY_HZ = 5;
const SAMPLES = 400;
/** The view is placed once every camera has an image, or when it is clear that one of them has none. */
const HOME_WAIT_MS = 1500;
const FRUSTUM_SHARE = 0.16;
const MOST_PIXEL_RATIO = 2;

/**
 * @typedef {Object} CloudOptions
 * @property {() => void} askWatch
 * @property {ReadonlyMap<string, Geometry>} geometries by stream
 * @property {() => {range: import("./colormap.js").Range, isAutomatic: boolean}} range
 * @property {() => {isLive: boolean, isPaused: boolean, fastestHz: number}} state of the connection, and of a replay
 * @property {(isOpen: boolean) => void} onToggled
 */

export class CloudView {
  isOpen = false;
  #section = byId("cloud", HTMLElement);
  #box = byId("cloud-box", HTMLElement);
  #canvas = byId("cloud-canvas", HTMLCanvasElement);
  #message = byId("cloud-message", HTMLElement);
  #facts = byId("cloud-facts", HTMLElement);
  #button = byId("show-cloud", HTMLButtonElement);
  #bar;
  #labels = new CloudLabels(byId("cloud-labels", HTMLElement));
  #thinning = new Thinning();
  /** @type {CloudRenderer | null} */
  #renderer = null;
  /** Why nothing can be drawn; empty if it can. */
  #failure = "";
  #isContextLost = false;
  /** @type {ReadonlyMap<string, Geometry>} by stream */
  #geometries;
  /** @type {CloudSource[]} */
  #sources = [];
  #built = "";
  /** @type {Status | null} */
  #status = null;
  /** @type {Orbit} */
  #orbit = { target: [0, 0, 1], up: [0, -1, 0], distance: 2, yaw: 0, pitch: 0.4 };
  #floor = 1;
  #isHomeDue = true;
  #openedAt = 0;
  #isDirty = false;
  #isFrameAsked = false;
  /** @type {{at: number, points: number} | null} the frame that is drawn */
  #drawing = null;
  #ms = 0;
  #options;

  /** For tests and for a look from the console. */
  facts = {
    isOpen: false,
    /** @type {number[]} column by column */
    viewProjection: [],
    width: 0,
    height: 0,
    points: 0,
    offered: 0,
    frames: 0,
    ms: 0,
    /** @type {string[]} */
    stale: [],
    /** @type {string[]} */
    placed: [],
  };

  /** @param {CloudOptions} options */
  constructor(options) {
    this.#options = options;
    this.#geometries = options.geometries;
    const input = new CloudInput(this.#canvas, {
      orbit: () => this.#orbit,
      move: (orbit) => {
        this.#orbit = orbit;
        this.#isHomeDue = false;
        this.redraw();
      },
      reset: () => this.#reset(),
      nextPaint: () => {
        announce(this.#bar.nextPaint());
        this.redraw();
      },
    });
    input.listen();
    this.#bar = new CloudBar({
      onPaint: () => this.redraw(),
      onChosen: (source) => {
        source.clear();
        this.#options.askWatch();
        this.redraw();
      },
      onLimit: () => {
        this.#thinning.setLimit(this.#bar.limit);
        this.#options.askWatch();
        this.redraw();
      },
      onReset: () => this.#reset(),
      onClose: () => this.close(),
    });
    this.#canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.#isContextLost = true;
      this.#renderer = null;
      this.#drawing = null;
      this.#sources.forEach((source) => source.release(null));
      this.#say();
    });
    this.#canvas.addEventListener("webglcontextrestored", () => {
      this.#isContextLost = false;
      this.#createRenderer();
      this.redraw();
    });
    new ResizeObserver(() => this.redraw()).observe(this.#box);
    document.addEventListener("visibilitychange", () => this.#sources.forEach((source) => source.clear()));
    this.#button.addEventListener("click", () => this.toggle());
  }

  toggle() {
    if (this.isOpen) {
      this.close();
    } else {
      this.open();
    }
  }

  open() {
    this.#setOpen(true);
    this.#openedAt = performance.now();
    this.#createRenderer();
    this.#canvas.focus({ preventScroll: true });
    this.redraw();
    announce("3-D view");
  }

  close() {
    if (!this.isOpen) {
      return;
    }
    this.#setOpen(false);
    // Its memory on the graphics card is free for other programs; the context is kept for the next time.
    this.#sources.forEach((source) => source.release(this.#renderer));
    announce("All streams");
  }

  /** @param {boolean} isOpen */
  #setOpen(isOpen) {
    this.isOpen = isOpen;
    this.facts.isOpen = isOpen;
    this.#section.hidden = !isOpen;
    this.#button.setAttribute("aria-pressed", String(isOpen));
    this.#options.onToggled(isOpen);
    this.#options.askWatch();
  }

  #createRenderer() {
    if (this.#renderer !== null || this.#isContextLost) {
      return;
    }
    const gl = this.#canvas.getContext("webgl2", { alpha: false, antialias: false });
    this.#failure = gl === null ? NO_WEBGL : "";
    try {
      this.#renderer = gl === null ? null : new CloudRenderer(gl);
    } catch (error) {
      this.#failure = error instanceof Error ? error.message : String(error);
    }
    this.#say();
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    const streams = sourcesOf(shownCameras(status), isDepthFormat);
    const built = JSON.stringify(streams);
    if (built !== this.#built) {
      this.#built = built;
      this.#sources.forEach((source) => source.release(this.#renderer));
      this.#sources = streams.map((stream, i) =>
        new CloudSource(stream, TINTS[i % TINTS.length], this.#geometries, () => this.#prepared()));
      for (const source of this.#sources) {
        const first = this.#sources.find(({ camera }) => camera === source.camera);
        source.isShown = source === first;
      }
      this.#bar.offer(this.#sources);
      this.#options.askWatch();
    }
  }

  /** Takes every camera's points away: what comes next are the images of something else. */
  clear() {
    this.#sources.forEach((source) => source.release(this.#renderer));
    this.#sources = [];
    this.#built = "";
    this.#reset();
  }

  /** The depth that the range of the colours follows. */
  get sources() {
    return this.isOpen ? this.#sources : [];
  }

  /**
   * The streams that it needs; `null` while it is closed.
   *
   * @returns {Watch[] | null}
   */
  watch() {
    if (!this.isOpen) {
      return null;
    }
    if (this.#failure !== "") {
      return [];
    }
    const shown = this.#sources.filter(({ isShown }) => isShown);
    const hz = shown.length <= FEW_CAMERAS ? FEW_HZ : MANY_HZ;
    const width = cloudWidth(this.#bar.limit ?? 0, shown.length);
    const colors = new Set(shown.flatMap(({ colorId }) => colorId ?? []));
    return [
      ...shown.map(({ id }) => ({ stream: id, width, rate_hz: hz })),
      ...[...colors].map((stream) => ({ stream, width: SMALL_WIDTH, rate_hz: hz })),
    ];
  }

  /**
   * @param {string} stream
   * @param {import("./slot.js").Delivery} delivery
   * @returns {boolean} whether it takes the image
   */
  accept(stream, delivery) {
    if (!this.isOpen || this.#renderer === null) {
      return false;
    }
    const sources = this.#sources.filter(({ id, colorId, isShown }) => isShown && (id === stream || colorId === stream));
    // A colour image may be for two depths of one camera; it has one credit.
    sources.forEach((source, i) => source.accept(stream, i === 0 ? delivery : { ...delivery, credit: () => {} }));
    return sources.length > 0;
  }

  #prepared() {
    if (document.hidden || !this.isOpen || this.#renderer === null) {
      this.#sources.forEach((source) => source.clear());
      return;
    }
    this.redraw();
  }

  /** Follows the clock: points of a camera that has gone turn grey. @param {number} now ms */
  tick(now) {
    if (!this.isOpen) {
      return;
    }
    const { isLive, isPaused } = this.#options.state();
    for (const source of this.#sources) {
      if (source.follow(!isLive || this.#isLost(source), now, isPaused)) {
        this.redraw();
      }
    }
    this.#say();
  }

  /**
   * Whether the daemon says that the camera has no images.
   *
   * @param {CloudSource} source
   */
  #isLost(source) {
    const cameras = this.#status === null ? [] : shownCameras(this.#status);
    const camera = cameras.find(({ name }) => name === source.camera);
    const stream = camera?.streams.find(({ id }) => id === source.id);
    if (camera?.state !== "streaming" || stream === undefined) {
      return true;
    }
    const hz = Math.min(MANY_HZ, this.#options.state().fastestHz);
    return (stream.last_frame_age_ms ?? 0) > STALE_MS + periodMs(hz, stream.nominal_hz);
  }

  redraw() {
    this.#isDirty = true;
    this.#askFrame();
  }

  #askFrame() {
    if (this.isOpen && !this.#isFrameAsked) {
      this.#isFrameAsked = true;
      requestAnimationFrame(() => {
        this.#isFrameAsked = false;
        this.#frame(performance.now());
      });
    }
  }

  /** @param {number} now ms */
  #frame(now) {
    const renderer = this.#renderer;
    if (renderer === null || !this.isOpen) {
      return;
    }
    for (const source of this.#sources) {
      this.#isDirty = source.upload(renderer) || this.#isDirty;
    }
    if (this.#drawing !== null && !renderer.isBusy) {
      this.#ms = now - this.#drawing.at;
      this.#thinning.drawn(this.#ms, this.#drawing.points);
      this.#drawing = null;
      this.facts.frames += 1;
      this.facts.ms = this.#ms;
    }
    if (this.#drawing === null && this.#isDirty) {
      this.#isDirty = false;
      this.#draw(renderer, now);
    }
    if (this.#drawing !== null) {
      this.#askFrame();
    }
  }

  /**
   * @param {CloudRenderer} renderer
   * @param {number} now
   */
  #draw(renderer, now) {
    this.#fit();
    this.tick(now);
    const offered = this.#sources.reduce((sum, source) => sum + source.offered, 0);
    const share = Math.min(1, this.#thinning.budget / Math.max(1, offered));
    const clouds = this.#sources.flatMap((source) => source.points(renderer, share) ?? []);
    this.#homeIfDue(now);
    const { width, height } = this.#canvas;
    const projection = projectionMatrix(this.#orbit, width / Math.max(1, height));
    const viewProjection = multiply(projection, viewMatrix(this.#orbit));
    const { range, isAutomatic } = this.#options.range();
    renderer.draw({
      viewProjection,
      projection,
      range,
      isClipped: !isAutomatic,
      paint: this.#bar.paint,
      clouds,
      lines: this.#lines(),
    });
    const points = clouds.reduce((sum, { grid }) => sum + grid.columns * grid.rows, 0);
    this.#drawing = { at: now, points };
    this.#show(viewProjection, points, offered);
  }

  #fit() {
    const ratio = Math.min(MOST_PIXEL_RATIO, devicePixelRatio);
    const width = Math.max(1, Math.round(this.#box.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.#box.clientHeight * ratio));
    if (this.#canvas.width !== width || this.#canvas.height !== height) {
      this.#canvas.width = width;
      this.#canvas.height = height;
    }
  }

  /** Sources that have a place. */
  get #placed() {
    return this.#sources.filter(({ isShown, geometry }) => isShown && geometry !== null);
  }

  #lines() {
    const depthM = FRUSTUM_SHARE * this.#orbit.distance;
    const frusta = this.#placed.map((source) => {
      const { intrinsics, width, height } = /** @type {Geometry} */ (source.geometry);
      const pose = poseOf(/** @type {Geometry} */ (source.geometry));
      const lines = frustumLines(intrinsics, width, height, pose, Math.min(0.25, depthM));
      /** @type {[number, number, number]} */
      const color = source.isStale || source.isGone ? [0.45, 0.45, 0.45] : source.tint;
      return { lines, color };
    });
    const { up, target, distance } = this.#orbit;
    const floor = floorLines(up, this.#floor, target, distance);
    return [{ lines: floor.lines, color: /** @type {[number, number, number]} */ ([0.2, 0.22, 0.26]) }, ...frusta];
  }

  /**
   * @param {number[]} viewProjection
   * @param {number} points
   * @param {number} offered
   */
  #show(viewProjection, points, offered) {
    const placed = this.#placed;
    const size = { width: this.#box.clientWidth, height: this.#box.clientHeight };
    this.#labels.show(placed, viewProjection, size);
    const count = (/** @type {number} */ n) => n.toLocaleString("en");
    const { cellM } = floorLines(this.#orbit.up, 0, this.#orbit.target, this.#orbit.distance);
    const speed = this.#ms > 0 ? ` · ${Math.round(this.#ms)} ms a frame` : "";
    setText(this.#facts, `${count(points)} of ${count(offered)} points${speed} · floor cells ${cellM * 100} cm`);
    Object.assign(this.facts, {
      viewProjection, ...size, points, offered,
      stale: this.#sources.filter(({ isStale }) => isStale).map(({ id }) => id),
      placed: placed.map(({ id }) => id),
    });
  }

  #reset() {
    this.#isHomeDue = true;
    this.#openedAt = -Infinity;
    this.redraw();
  }

  /** @param {number} now ms */
  #homeIfDue(now) {
    const placed = this.#placed;
    const ready = placed.filter(({ shown }) => shown !== null);
    const isComplete = ready.length === this.#sources.filter(({ isShown }) => isShown).length;
    if (!this.#isHomeDue || ready.length === 0 || (!isComplete && now - this.#openedAt < HOME_WAIT_MS)) {
      return;
    }
    this.#isHomeDue = false;
    const poses = ready.map(({ geometry }) => poseOf(/** @type {Geometry} */ (geometry)));
    const samples = ready.flatMap((source) => source.samples(SAMPLES));
    const up = this.#bar.up ?? upOf(poses);
    this.#orbit = home(poses, samples, up);
    const heights = samples.length > 0 ? samples : [this.#orbit.target];
    this.#floor = quantile(heights.map((point) => dot(point, up)), 0.02);
  }

  #say() {
    if (this.isOpen) {
      const hint = cloudHint(this.#sources, (id) => this.#geometries.has(id));
      setText(this.#message, this.#isContextLost ? LOST : this.#failure || hint);
    }
  }
}
