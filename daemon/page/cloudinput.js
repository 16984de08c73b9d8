/** Mouse, touch and keyboard of the 3-D view. */

import { panned, turned, zoomed } from "./orbit.js";

/** @typedef {import("./orbit.js").Orbit} Orbit */

/** A drag over the height of the view turns half around. */
const TURN = Math.PI;
const WHEEL = 0.0015;
const LINE_PX = 16;
const KEY_TURN = Math.PI / 24;
const KEY_PAN = 0.05;
const KEY_ZOOM = 1.15;

/**
 * @typedef {Object} InputOptions
 * @property {() => Orbit} orbit
 * @property {(orbit: Orbit) => void} move
 * @property {() => void} reset
 * @property {() => void} nextPaint
 */

/**
 * The orbit after a key; `null` if the key is not one of the view's.
 *
 * @param {Orbit} orbit
 * @param {string} key
 * @param {boolean} isShift
 * @returns {Orbit | null}
 */
export function movedByKey(orbit, key, isShift) {
  const across = key === "ArrowLeft" ? 1 : key === "ArrowRight" ? -1 : 0;
  const along = key === "ArrowUp" ? 1 : key === "ArrowDown" ? -1 : 0;
  if (across !== 0 || along !== 0) {
    return isShift ? panned(orbit, across * KEY_PAN, along * KEY_PAN) : turned(orbit, across * KEY_TURN, along * KEY_TURN);
  }
  if (key === "+" || key === "=") {
    return zoomed(orbit, 1 / KEY_ZOOM);
  }
  return key === "-" || key === "_" ? zoomed(orbit, KEY_ZOOM) : null;
}

export class CloudInput {
  /** @type {Map<number, {x: number, y: number}>} */
  #pointers = new Map();
  #element;
  #options;

  /**
   * @param {HTMLElement} element
   * @param {InputOptions} options
   */
  constructor(element, options) {
    this.#element = element;
    this.#options = options;
  }

  /** Listens from now on. */
  listen() {
    const element = this.#element;
    const options = this.#options;
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    element.addEventListener("pointermove", (event) => this.#dragged(event));
    for (const end of /** @type {const} */ (["pointerup", "pointercancel", "lostpointercapture"])) {
      element.addEventListener(end, (event) => this.#pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      const pixels = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? event.deltaY * LINE_PX : event.deltaY;
      options.move(zoomed(options.orbit(), Math.exp(pixels * WHEEL)));
    }, { passive: false });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("keydown", (event) => this.#pressed(event));
  }

  /** @param {PointerEvent} event */
  #dragged(event) {
    const before = this.#pointers.get(event.pointerId);
    if (before === undefined) {
      return;
    }
    const now = { x: event.clientX, y: event.clientY };
    const others = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.#pointers.set(event.pointerId, now);
    const height = Math.max(1, this.#element.clientHeight);
    const right = (now.x - before.x) / height;
    const down = (now.y - before.y) / height;
    const orbit = this.#options.orbit();
    if (others.length > 0) {
      // Two fingers: their distance zooms, their middle moves.
      const [other] = others;
      const apart = (/** @type {{x: number, y: number}} */ p) => Math.max(1, Math.hypot(p.x - other.x, p.y - other.y));
      this.#options.move(zoomed(panned(orbit, right / 2, down / 2), apart(before) / apart(now)));
    } else if (event.shiftKey || (event.buttons & 6) !== 0) {
      this.#options.move(panned(orbit, right, down));
    } else {
      this.#options.move(turned(orbit, -right * TURN, down * TURN));
    }
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) {
      return;
    }
    const moved = movedByKey(this.#options.orbit(), event.key, event.shiftKey);
    const isOther = event.key === "0" || event.key === "Home" || event.key === "t" || event.key === "T";
    if (moved === null && !isOther) {
      return;
    }
    // The arrows also step a replay, when the view does not have the focus.
    event.preventDefault();
    event.stopPropagation();
    if (moved !== null) {
      this.#options.move(moved);
    } else if (event.key === "0" || event.key === "Home") {
      this.#options.reset();
    } else {
      this.#options.nextPaint();
    }
  }
}
