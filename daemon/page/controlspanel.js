/** The panel of the cameras' controls: they take effect at once, and are written to the rig file on demand. */

import { get, messageOf, post } from "./api.js";
import { ControlRow } from "./controlrow.js";
import { differsFromFile } from "./controltext.js";
import { announce, make, makeButton, makeText, setState, setText } from "./dom.js";
import { SaveDialog } from "./savedialog.js";

/** @typedef {import("./paneltypes.js").ControlList} ControlList */
/** @typedef {import("./paneltypes.js").CameraControls} CameraControls */
/** @typedef {import("./paneltypes.js").ControlValue} ControlValue */

/** Another page, or the camera itself, may change a value. */
const POLL_MS = 1200;

class CameraSection {
  element = make("section", "camera-controls");
  #problem = make("p", "why");
  #list = make("div", "");
  #changed = make("span", "quiet");
  #back;
  /** @type {Map<string, ControlRow>} */
  #rows = new Map();
  /** The controls that the rows were built for. */
  #built = "";
  #camera;
  #set;

  /**
   * @param {string} camera
   * @param {(name: string, value: ControlValue) => Promise<void>} set
   * @param {() => void} revert
   */
  constructor(camera, set, revert) {
    this.#camera = camera;
    this.#set = set;
    this.#back = makeButton("Back to the rig file", revert);
    this.#back.setAttribute("aria-label", `Back to the rig file: ${camera}`);
    const head = make("div", "panel-line");
    head.append(makeText("h3", "", camera), this.#changed, this.#back);
    this.element.dataset.camera = camera;
    this.element.append(head, this.#problem, this.#list);
  }

  /** @param {CameraControls} entry */
  update(entry) {
    const { controls, problem } = entry;
    this.#back.hidden = controls.length === 0;
    const none = controls.length === 0 ? "This camera has no controls." : "";
    setText(this.#problem, problem ?? none);
    const built = JSON.stringify(controls.map(({ name, kind, minimum, maximum, step, items }) => [name, kind, minimum, maximum, step, items]));
    if (built !== this.#built) {
      this.#built = built;
      this.#rows = new Map(controls.map((control) => [control.name, new ControlRow(control, this.#set)]));
      this.#list.replaceChildren(...[...this.#rows.values()].map((row) => row.element));
    }
    for (const control of controls) {
      this.#rows.get(control.name)?.update(control);
    }
    const changed = controls.filter(differsFromFile).length;
    setText(this.#changed, changed > 0 ? `${changed} not as in the rig file` : "");
  }

  /** @param {string | null} name of the control; `null`: all */
  release(name) {
    for (const [own, row] of this.#rows) {
      if (name === null || name === own) {
        row.release();
      }
    }
  }

  get camera() {
    return this.#camera;
  }
}

export class ControlsPanel {
  element = make("section", "controls");
  #write = makeButton("Write to rig file…", () => void this.#dialog.ask());
  #said = make("p", "said");
  #cameras = make("div", "");
  /** @type {Map<string, CameraSection>} */
  #sections = new Map();
  #isOpen = false;
  #timer = 0;
  #isLoading = false;
  /** What was set since a list was asked for is newer than the list. */
  #changes = 0;
  #dialog = new SaveDialog((file) => this.#saved(file));

  constructor() {
    this.#said.setAttribute("role", "status");
    this.#write.disabled = true;
    const head = make("div", "panel-line");
    head.append(this.#write);
    this.element.append(head, this.#said, this.#cameras);
  }

  open() {
    this.#isOpen = true;
    void this.#poll();
  }

  close() {
    this.#isOpen = false;
    clearTimeout(this.#timer);
    this.#dialog.close();
    this.#say("");
  }

  async #poll() {
    clearTimeout(this.#timer);
    if (!document.hidden) {
      await this.#load();
    }
    if (this.#isOpen) {
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => void this.#poll(), POLL_MS);
    }
  }

  async #load() {
    if (this.#isLoading) {
      return;
    }
    this.#isLoading = true;
    const before = this.#changes;
    try {
      const list = /** @type {ControlList} */ (await get("/v1/controls"));
      if (before === this.#changes) {
        this.#show(list);
      }
      if (this.element.dataset.state === "failed") {
        this.#say("");
      }
      setState(this.element, "listed");
    } catch (error) {
      setState(this.element, "failed");
      this.#say(`The controls are not known: ${messageOf(error)}`);
    }
    this.#isLoading = false;
  }

  /** @param {ControlList} list */
  #show(list) {
    this.#write.disabled = list.file === null;
    this.#write.title = list.file ?? "This rig runs without a rig file";
    const names = list.cameras.map(({ camera }) => camera);
    if (names.join("\n") !== [...this.#sections.keys()].join("\n")) {
      this.#sections = new Map(names.map((name) => [name, this.#section(name)]));
      this.#cameras.replaceChildren(...[...this.#sections.values()].map(({ element }) => element));
    }
    for (const entry of list.cameras) {
      this.#sections.get(entry.camera)?.update(entry);
    }
  }

  /** @param {string} camera */
  #section(camera) {
    return new CameraSection(
      camera,
      (name, value) => this.#ask(camera, name, "/v1/controls", { camera, name, value }),
      () => void this.#ask(camera, null, "/v1/controls/revert", { camera }),
    );
  }

  /**
   * @param {string} camera
   * @param {string | null} name of the control; `null`: all
   * @param {string} path
   * @param {Record<string, unknown>} body
   */
  async #ask(camera, name, path, body) {
    this.#changes += 1;
    const section = this.#sections.get(camera);
    try {
      const entry = /** @type {CameraControls | null} */ (await post(path, body));
      if (name === null) {
        section?.release(null);
        this.#say(`${camera} is as the rig file has it.`);
        announce(`${camera} is as the rig file has it.`);
      } else {
        this.#say("");
      }
      if (entry !== null && Array.isArray(entry.controls)) {
        section?.update(entry);
      }
    } catch (error) {
      section?.release(name);
      this.#say(`${camera}${name === null ? "" : `, ${name}`}: ${messageOf(error)}`);
    }
    if (name === null) {
      await this.#load();
    }
  }

  /** @param {string} file */
  #saved(file) {
    this.#say(`Written to ${file}.`);
    void this.#load();
  }

  /** @param {string} text */
  #say(text) {
    setText(this.#said, text);
  }
}
