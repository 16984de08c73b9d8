/** The question before the rig file is written: the difference, and yes or no. */

import { ApiError, get, messageOf, post } from "./api.js";
import { diffLines } from "./controltext.js";
import { make, makeButton, makeText, setText } from "./dom.js";

/** @typedef {import("./paneltypes.js").ControlChanges} ControlChanges */

export class SaveDialog {
  #dialog = document.createElement("dialog");
  #title = makeText("h2", "", "Write to the rig file");
  #diff = make("pre", "diff");
  #said = make("p", "said");
  #write = makeButton("Write", () => void this.#save());
  #fingerprint = "";
  #onSaved;

  /** @param {(file: string) => void} onSaved */
  constructor(onSaved) {
    this.#onSaved = onSaved;
    this.#dialog.id = "save-controls";
    this.#title.id = "save-controls-title";
    this.#dialog.setAttribute("aria-labelledby", this.#title.id);
    this.#said.setAttribute("role", "alert");
    this.#diff.tabIndex = 0;
    this.#diff.setAttribute("aria-label", "Difference");
    const buttons = make("div", "buttons");
    buttons.append(this.#write, makeButton("Cancel", () => this.#dialog.close()));
    this.#dialog.append(this.#title, this.#diff, this.#said, buttons);
    document.body.append(this.#dialog);
  }

  async ask() {
    setText(this.#said, "");
    this.#dialog.showModal();
    await this.#load();
  }

  close() {
    this.#dialog.close();
  }

  async #load() {
    this.#write.disabled = true;
    this.#diff.replaceChildren();
    try {
      const changes = /** @type {ControlChanges} */ (await get("/v1/controls/changes"));
      this.#fingerprint = changes.fingerprint;
      setText(this.#title, `Write to ${changes.file ?? "the rig file"}`);
      const isSame = changes.diff === "";
      this.#diff.hidden = isSame;
      this.#diff.replaceChildren(...diffLines(changes.diff).map(({ kind, text }) => makeText("span", kind, `${text}\n`)));
      if (isSame) {
        setText(this.#said, "The rig file has these values already.");
      }
      this.#write.disabled = isSame;
    } catch (error) {
      setText(this.#said, `The difference is not known: ${messageOf(error)}`);
    }
  }

  async #save() {
    this.#write.disabled = true;
    try {
      const answer = /** @type {{file?: string} | null} */ (
        await post("/v1/controls/save", { fingerprint: this.#fingerprint })
      );
      this.#dialog.close();
      this.#onSaved(answer?.file ?? "the rig file");
    } catch (error) {
      if (error instanceof ApiError && error.kind === "wrong_state") {
        await this.#load();
        setText(this.#said, `Not written: ${messageOf(error)}. This is the difference now.`);
      } else {
        setText(this.#said, `Not written: ${messageOf(error)}`);
        this.#write.disabled = false;
      }
    }
  }
}
