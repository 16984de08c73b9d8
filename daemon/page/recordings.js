/** The panel of the recordings: a list, marks, watching, reports. Nothing is deleted from here. */

import { ApiError, get, getBlob, messageOf, post } from "./api.js";
import { announce, make, makeButton, setState, setText } from "./dom.js";
import { RecordingRow } from "./recordingrow.js";

/** @typedef {import("./paneltypes.js").RecordingList} RecordingList */
/** @typedef {import("./paneltypes.js").RecordingEntry} RecordingEntry */
/** @typedef {import("./paneltypes.js").Mark} Mark */

/** Reading the folders may take a while on a disk that is busy. */
const LIST_MS = 20_000;
/** The report of a recording is written after its end. */
const REPORT_WITHIN_MS = 60_000;
const REPORT_EVERY_MS = 2000;

/** @param {RecordingEntry} entry */
function isReportDue({ has_report, health, started_utc_ns, duration_ns }) {
  const endedMs = ((started_utc_ns ?? 0) + (duration_ns ?? 0)) / 1e6;
  return !has_report && health !== "recording" && Math.abs(Date.now() - endedMs) < REPORT_WITHIN_MS;
}

export class Recordings {
  element = make("section", "recordings");
  #said = make("p", "said");
  #undo = makeButton("Undo", () => this.#undoing?.());
  #refresh = makeButton("Refresh", () => void this.#load());
  #where = make("p", "quiet");
  #list = make("ul", "recording-list");
  #more = make("p", "quiet");
  /** @type {Map<string, RecordingRow>} by name */
  #rows = new Map();
  /** @type {(() => void) | null} */
  #undoing = null;
  /** @type {RecordingRow[]} whose images are to be fetched */
  #wanted = [];
  #isFetching = false;
  #timer = 0;
  #isOpen = false;
  #isLoading = false;
  #isStale = false;
  /** The recording of the last status, and whether it goes on: a change means another list. */
  #recording = "";
  #onWatch;
  /** @type {string | null} */
  #watched = null;

  /** @param {(name: string) => void} onWatch */
  constructor(onWatch) {
    this.#onWatch = onWatch;
    this.#said.setAttribute("role", "status");
    this.#undo.hidden = true;
    const head = make("div", "panel-line");
    head.append(this.#refresh, this.#said, this.#undo);
    this.#list.addEventListener("keydown", (event) => this.#arrow(event));
    this.element.append(head, this.#where, this.#list, this.#more);
  }

  open() {
    this.#isOpen = true;
    void this.#load();
  }

  close() {
    this.#isOpen = false;
    this.#say("", null);
  }

  /** @param {import("./types.js").Status} status */
  update(status) {
    const { recording } = status;
    const now = recording === null ? "" : `${recording.path} ${recording.active}`;
    if (now !== this.#recording) {
      this.#recording = now;
      void this.#load();
    }
  }

  /** @param {string | null} name the dataset that is shown on the wall */
  setWatched(name) {
    this.#watched = name;
    for (const row of this.#rows.values()) {
      row.setWatched(row.entry.name === name);
    }
  }

  /** @param {RecordingEntry} entry that was changed elsewhere on this page */
  marked(entry) {
    this.#rows.get(entry.name)?.update(entry);
  }

  async #load() {
    if (!this.#isOpen) {
      return;
    }
    if (this.#isLoading) {
      // What is being read may be older than what it is read for.
      this.#isStale = true;
      return;
    }
    this.#isLoading = true;
    this.element.setAttribute("aria-busy", "true");
    try {
      const list = /** @type {RecordingList} */ (await get("/v1/recordings", LIST_MS));
      this.#show(list);
      setState(this.element, "listed");
    } catch (error) {
      setState(this.element, "failed");
      setText(this.#where, `The recordings were not listed: ${messageOf(error)}`);
    }
    this.element.removeAttribute("aria-busy");
    this.#isLoading = false;
    if (this.#isStale) {
      this.#isStale = false;
      await this.#load();
    }
  }

  /** @param {RecordingList} list */
  #show(list) {
    const { directory, recordings, more } = list;
    const names = new Set(recordings.map(({ name }) => name));
    for (const [name, row] of this.#rows) {
      if (!names.has(name)) {
        row.element.remove();
        this.#rows.delete(name);
      }
    }
    let before = /** @type {Element | null} */ (null);
    for (const entry of recordings) {
      const row = this.#row(entry);
      // A row that is moved loses the focus.
      const place = before === null ? this.#list.firstElementChild : before.nextElementSibling;
      if (place !== row.element) {
        this.#list.insertBefore(row.element, place);
      }
      before = row.element;
    }
    this.setWatched(this.#watched);
    setText(this.#where, recordings.length === 0 ? `No recordings in ${directory}` : `In ${directory}`);
    setText(this.#more, more > 0 ? `${more} older ones are not shown.` : "");
    void this.#fetchImages();
    if (recordings.some(isReportDue)) {
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => void this.#load(), REPORT_EVERY_MS);
    }
  }

  /** @param {RecordingEntry} entry */
  #row(entry) {
    let row = this.#rows.get(entry.name);
    if (row === undefined) {
      row = new RecordingRow(entry, {
        mark: (of, mark) => void this.#mark(of, mark),
        watch: (of) => this.#onWatch(of.name),
        report: (of) => void this.#report(of),
      });
      this.#rows.set(entry.name, row);
    } else {
      row.update(entry);
    }
    // One that is being closed may have none yet.
    if (!row.hasImage && row.imageAskedAs !== entry.health && entry.health !== "recording") {
      row.imageAskedAs = entry.health;
      this.#wanted.push(row);
    }
    return row;
  }

  /** One after the other: the images of the wall are to come first. */
  async #fetchImages() {
    if (this.#isFetching) {
      return;
    }
    this.#isFetching = true;
    while (this.#isOpen && this.#wanted.length > 0) {
      const row = this.#wanted.shift();
      if (row !== undefined) {
        await fetchImage(row);
      }
    }
    this.#isFetching = false;
  }

  /**
   * @param {RecordingEntry} entry
   * @param {Mark} mark
   */
  async #mark(entry, mark) {
    const before = entry.mark;
    try {
      const marked = /** @type {RecordingEntry} */ (await post("/v1/recordings/mark", { name: entry.name, mark }));
      this.#rows.get(entry.name)?.update(marked);
      const text = mark === null ? `${entry.name} has no mark now.` : `${entry.name} is marked ${mark}.`;
      this.#say(text, () => void this.#mark(marked, before));
    } catch (error) {
      this.#failed(`${entry.name} was not marked`, error);
    }
  }

  /** @param {RecordingEntry} entry */
  async #report(entry) {
    try {
      const { path } = /** @type {{path: string}} */ (await post("/v1/recordings/report", { name: entry.name }));
      // Only a path of this origin: what is opened must not come from a name.
      const address = new URL(path, location.origin);
      if (address.origin !== location.origin) {
        throw new ApiError("other", "the daemon answered with another address");
      }
      open(address, "_blank", "noopener");
      this.#say(`The report of ${entry.name} is in a new tab.`, null);
    } catch (error) {
      this.#failed(`The report of ${entry.name} was not opened`, error);
    }
  }

  /**
   * @param {string} what
   * @param {unknown} error
   */
  #failed(what, error) {
    this.#say(`${what}: ${messageOf(error)}`, null);
    // It may be gone, or be another one by now.
    void this.#load();
  }

  /**
   * @param {string} text
   * @param {(() => void) | null} undo
   */
  #say(text, undo) {
    setText(this.#said, text);
    announce(text);
    this.#undoing = undo;
    this.#undo.hidden = undo === null;
  }

  /**
   * The same button of the recording above or below.
   *
   * @param {KeyboardEvent} event
   */
  #arrow(event) {
    const down = event.key === "ArrowDown";
    const row = event.target instanceof Element ? event.target.closest("li") : null;
    if (row === null || (!down && event.key !== "ArrowUp")) {
      return;
    }
    event.preventDefault();
    const at = [...row.querySelectorAll("button")].findIndex((button) => button === event.target);
    const next = down ? row.nextElementSibling : row.previousElementSibling;
    const buttons = [...(next?.querySelectorAll("button") ?? [])].filter((button) => !button.disabled && !button.hidden);
    buttons[Math.min(at, buttons.length - 1)]?.focus();
  }
}

/** @param {RecordingRow} row */
async function fetchImage(row) {
  try {
    const blob = await getBlob(`/v1/recordings/image?name=${encodeURIComponent(row.entry.name)}`);
    row.showImage(await createImageBitmap(blob));
  } catch {
    // Without an image the row says so.
  }
}
