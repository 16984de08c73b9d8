/** Aids for setting up a depth camera: holes, noise, flatness. */

import { DepthSum, FRAMES, filledState, noiseEndMm, paintHoles, paintNoise } from "./depthstats.js";
import { byId, setState, setText } from "./dom.js";
import { isKnown, unprojector } from "./lens.js";
import { fitPlane, insideImage, middleRect, pointsIn } from "./plane.js";
import { depthOf } from "./protocol.js";

/** @typedef {import("./plane.js").Rect} Rect */
/** @typedef {import("./plane.js").Plane} Plane */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./types.js").Image} Image */

const PLANE_POINTS = 4000;
const MM_PER_M = 1000;
/** A key moves or widens the rectangle by this share of the image. */
const KEY_SHARE = 0.03;

export class DepthAids {
  #box = byId("aids-depth", HTMLElement);
  #filled = byId("aids-filled", HTMLElement);
  #noise = byId("aids-noise", HTMLElement);
  #map = byId("aids-map", HTMLSelectElement);
  #scale = byId("aids-scale", HTMLElement);
  #usesPlane = byId("aids-plane", HTMLInputElement);
  #move = byId("aids-plane-move", HTMLButtonElement);
  #planeText = byId("aids-plane-text", HTMLElement);
  /** @type {DepthSum | null} */
  #sum = null;
  #sumOf = "";
  /** @type {import("./depthstats.js").DepthSummary | null} */
  #summary = null;
  /** @type {Rect | null} pixels of the full image */
  #rect = null;
  /** @type {Plane | null} */
  plane = null;
  /** @type {number | null} */
  holes = null;

  /** @param {() => void} onChange the layer is to be painted again */
  constructor(onChange) {
    this.#map.addEventListener("change", onChange);
    this.#usesPlane.addEventListener("change", () => {
      this.#move.disabled = !this.#usesPlane.checked;
      onChange();
    });
    this.#move.addEventListener("keydown", (event) => {
      if (this.#moved(event.key, event.shiftKey)) {
        // The arrows also step a replay.
        event.preventDefault();
        event.stopPropagation();
        onChange();
      }
    });
  }

  get usesPlane() {
    return this.#usesPlane.checked;
  }

  /** Of the last images that were summed up; `null` before the first 30. */
  get summary() {
    return this.#summary;
  }

  /** @param {boolean} isShown */
  reset(isShown) {
    this.#box.hidden = !isShown;
    this.#sum = null;
    this.#sumOf = "";
    this.#summary = null;
    this.#rect = null;
    this.plane = null;
    this.holes = null;
    setText(this.#filled, "Filled: measuring");
    setState(this.#filled, "none");
    setText(this.#planeText, "");
    this.#say();
  }

  /** @param {number | null} holes share of the full image */
  measured(holes) {
    this.holes = holes;
    if (holes !== null) {
      setText(this.#filled, `Filled ${((1 - holes) * 100).toFixed(1)} %, holes ${(holes * 100).toFixed(1)} %`);
      setState(this.#filled, filledState(holes));
    }
  }

  /** @param {Image} image */
  add(image) {
    const depth = depthOf(image);
    const key = `${image.columns} ${image.rows} ${image.unitM}`;
    if (this.#sum === null || this.#sumOf !== key) {
      this.#summary = null;
      this.#sumOf = key;
      this.#sum = new DepthSum(depth.length);
    }
    this.#sum.add(depth);
    if (this.#sum.isComplete) {
      this.#summary = this.#sum.summary(image.unitM);
      this.#sum = new DepthSum(depth.length);
    }
    this.#say();
  }

  #say() {
    const median = this.#summary?.medianMm ?? null;
    const isNone = this.#summary !== null && median === null;
    const progress = this.#summary === null ? `${this.#sum?.frames ?? 0} of ${FRAMES} images` : "no depth";
    const text = median === null ? progress : `median ${median.toFixed(2)} mm over ${FRAMES} images`;
    setText(this.#noise, `Noise: ${isNone ? "no depth" : text}`);
    setText(this.#scale, this.#legend());
  }

  #legend() {
    if (this.#map.value === "none") {
      return "";
    }
    if (this.#summary === null) {
      return `The map comes after ${FRAMES} images; camera and scene must stand still.`;
    }
    return this.#map.value === "noise"
      ? `Blue 0 mm, red ${noiseEndMm(this.#summary).toFixed(1)} mm and more`
      : "Blue: a hole now and then, red: always";
  }

  /** What is painted over the image; `null` for nothing. */
  get paint() {
    const summary = this.#summary;
    if (summary === null || this.#map.value === "none") {
      return null;
    }
    return this.#map.value === "noise"
      ? (/** @type {Uint32Array} */ overlay) => paintNoise(summary.deviationMm, noiseEndMm(summary), overlay)
      : (/** @type {Uint32Array} */ overlay) => paintHoles(summary.holes, overlay);
  }

  /**
   * Fits the plane in the rectangle.
   *
   * @param {Image} image
   * @param {Geometry | undefined} geometry
   */
  fit(image, geometry) {
    this.plane = null;
    if (!this.usesPlane) {
      setText(this.#planeText, "");
      return;
    }
    this.#rect ??= middleRect(image.fullColumns, image.fullRows);
    if (geometry === undefined || !isKnown(geometry.intrinsics)) {
      setText(this.#planeText, "The lens is not known; give its intrinsics in the rig file.");
      return;
    }
    const points = pointsIn(depthOf(image), image, this.#rect, unprojector(geometry.intrinsics), PLANE_POINTS);
    this.plane = fitPlane(points);
    setText(this.#planeText, planeText(this.plane));
  }

  /**
   * The rectangle in pixels of an image that was sent; `null` without one.
   *
   * @param {number} step
   * @returns {Rect | null}
   */
  rect(step) {
    if (this.#rect === null || !this.usesPlane) {
      return null;
    }
    const { left, top, width, height } = this.#rect;
    return { left: left / step, top: top / step, width: width / step, height: height / step };
  }

  /**
   * @param {Rect} rect
   * @param {Image} image
   */
  setRect(rect, image) {
    this.#rect = insideImage(rect, image.fullColumns, image.fullRows);
  }

  /**
   * @param {string} key
   * @param {boolean} isShift whether its size is meant
   */
  #moved(key, isShift) {
    const across = key === "ArrowLeft" ? -1 : key === "ArrowRight" ? 1 : 0;
    const along = key === "ArrowUp" ? -1 : key === "ArrowDown" ? 1 : 0;
    if (this.#rect === null || (across === 0 && along === 0)) {
      return false;
    }
    const step = Math.max(1, KEY_SHARE * Math.max(this.#rect.width, this.#rect.height) * 3);
    const { left, top, width, height } = this.#rect;
    this.#rect = isShift
      ? { left, top, width: Math.max(8, width + across * step), height: Math.max(8, height + along * step) }
      : { left: left + across * step, top: top + along * step, width, height };
    return true;
  }

  /** Brings the rectangle back into the image. @param {Image} image */
  keepInside(image) {
    if (this.#rect !== null) {
      this.setRect(this.#rect, image);
    }
  }
}

/** @param {Plane | null} plane */
function planeText(plane) {
  if (plane === null) {
    return "Too little depth here, or no surface.";
  }
  const rms = (plane.rmsM * MM_PER_M).toFixed(2);
  return `RMS ${rms} mm, tilt ${plane.tiltDeg.toFixed(1)}°, ${(plane.distanceM * MM_PER_M).toFixed(0)} mm away`;
}
