/** The panel of the calibration: the present one, and the capture of views while one runs. */

import { get, getStream, messageOf } from "./api.js";
import { BoardOverlay } from "./boardoverlay.js";
import { ageText, coverageText, stateText } from "./calibrationtext.js";
import { announce, make, makeText, setState, setText } from "./dom.js";
import { EventParser } from "./eventstream.js";
import { uncertaintyMap } from "./uncertaintymap.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./paneltypes.js").CaptureEvent} CaptureEvent */
/** @typedef {import("./paneltypes.js").CalibratedImage} CalibratedImage */

const AGAIN_MS = 2000;
/** A capture that says nothing for so long has ended without a word. */
const SILENT_MS = 10_000;

export class CalibrationPanel {
  element = make("section", "calibration");
  #capture = make("div", "capture");
  #present = make("div", "");
  #said = make("p", "said");
  #overlay;
  /** @type {AbortController | null} */
  #following = null;
  #timer = 0;
  #silence = 0;
  #shown = "";
  #state = "";
  /** @type {CalibratedImage[]} */
  #images = [];
  /** Why there are none; empty if they were read. */
  #withoutMaps = "";
  /** @type {Status | null} */
  #status = null;

  /** @param {ReadonlyMap<string, import("./tile.js").Tile>} tiles */
  constructor(tiles) {
    this.#overlay = new BoardOverlay(tiles);
    this.#said.setAttribute("role", "status");
    this.#capture.hidden = true;
    const how = "“depthrig calibrate capture” takes views of a board; what it sees is then shown here and on the images.";
    this.element.append(this.#said, this.#capture, makeText("h3", "", "Present calibration"), this.#present, makeText("p", "quiet", how));
  }

  open() {
    this.#following = new AbortController();
    void this.#follow(this.#following.signal);
    void this.#readMaps();
  }

  /** The calibration in use stays the same while the rig runs. */
  async #readMaps() {
    this.#withoutMaps = "";
    try {
      this.#images = /** @type {CalibratedImage[]} */ (await get("/v1/calibration"));
    } catch (error) {
      this.#withoutMaps = `The map of uncertainty was not read: ${messageOf(error)}`;
    }
    this.#shown = "";
    if (this.#status !== null) {
      this.update(this.#status);
    }
  }

  close() {
    clearTimeout(this.#timer);
    clearTimeout(this.#silence);
    this.#following?.abort();
    this.#following = null;
    this.#overlay.hide();
    this.#capture.hidden = true;
  }

  /** @param {AbortSignal} signal */
  async #follow(signal) {
    try {
      const stream = await getStream("/v1/calibration/events", signal);
      setText(this.#said, "");
      const reader = stream?.getReader();
      const decoder = new TextDecoder();
      const parser = new EventParser();
      for (;;) {
        const piece = await reader?.read();
        if (piece === undefined || piece.done) {
          break;
        }
        // Only the newest counts: the page may have slept.
        const newest = parser.push(decoder.decode(piece.value, { stream: true })).at(-1);
        if (newest !== undefined && !signal.aborted) {
          this.#show(/** @type {CaptureEvent} */ (JSON.parse(newest)));
        }
      }
    } catch (error) {
      if (!signal.aborted) {
        setText(this.#said, `Captures are not followed: ${messageOf(error)}`);
      }
    }
    if (!signal.aborted) {
      this.#overlay.hide();
      this.#timer = setTimeout(() => void this.#follow(signal), AGAIN_MS);
    }
  }

  /** @param {CaptureEvent} event */
  #show(event) {
    clearTimeout(this.#silence);
    const { progress } = event;
    const silentFor = Date.now() - event.utc_ns / 1e6;
    const isRunning = !event.is_finished && silentFor < SILENT_MS;
    this.#capture.hidden = false;
    setState(this.#capture, isRunning ? "running" : "ended");
    if (!isRunning) {
      this.#overlay.hide();
      const end = event.is_finished ? "has ended" : "has said nothing more";
      this.#capture.replaceChildren(makeText("h3", "", "Last capture"), makeText("p", "", `${progress.views} views in ${event.out}; it ${end}.`));
      return;
    }
    this.#silence = setTimeout(() => this.#show(event), SILENT_MS);
    this.#overlay.show(event);
    const state = makeText("p", "capture-state", stateText(progress.state));
    setState(state, progress.state);
    /** @type {HTMLElement[]} */
    const parts = [makeText("h3", "", `Capture: ${progress.views} views`), state];
    if (progress.hint !== null && progress.hint !== undefined) {
      parts.push(makeText("p", "hint", `Next: ${progress.hint.text}`));
    }
    parts.push(...event.refused.map((why) => makeText("p", "why", why)));
    for (const camera of progress.cameras) {
      const box = make("article", "capture-camera");
      setState(box, camera.missing.length === 0 ? "enough" : "missing");
      const missing = camera.missing.length === 0 ? "Nothing is missing" : `Missing: ${camera.missing.join("; ")}`;
      box.append(makeText("strong", "", camera.name), makeText("p", "", coverageText(camera)), makeText("p", "quiet", missing));
      parts.push(box);
    }
    const pairs = progress.pairs.map(({ a, b, shared, missing }) => `${a} and ${b}: ${shared}${missing > 0 ? `, ${missing} more wanted` : ""}`);
    if (pairs.length > 0) {
      parts.push(makeText("p", "quiet", `Common views: ${pairs.join("; ")}`));
    }
    this.#capture.replaceChildren(...parts);
    if (this.#state !== progress.state) {
      this.#state = progress.state;
      announce(stateText(progress.state));
    }
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    const cameras = status.cameras.map(({ name, mount }) => ({ name, mount: mount ?? null }));
    const shown = JSON.stringify(cameras);
    if (shown === this.#shown) {
      return;
    }
    this.#shown = shown;
    this.#present.replaceChildren(
      ...cameras.map(({ name, mount }) => {
        const box = make("article", "finding");
        box.append(makeText("strong", "", name));
        if (mount === null) {
          setState(box, "info");
          box.append(makeText("p", "quiet", "Not calibrated: its pose is that of the rig file."));
          return box;
        }
        setState(box, mount.warnings.length > 0 ? "warning" : "good");
        box.append(makeText("p", "", `${ageText(mount)}: ${mount.worth}`));
        box.append(...mount.warnings.map((warning) => makeText("p", "why", warning)));
        box.append(...this.#images.filter(({ stream }) => stream.startsWith(`${name}/`)).map(uncertaintyMap));
        return box;
      }),
      makeText("p", "why", this.#withoutMaps),
    );
  }
}
