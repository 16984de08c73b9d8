/** The panel of a recording's episodes. They are asked for while it is shown, when the status says that they changed. */

import { get, messageOf, post } from "./api.js";
import { make, makeButton, makeText, setState, setText } from "./dom.js";
import { EPISODE_TEXT, countsText, episodeState, lengthText } from "./episodetext.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Episode} Episode */
/** @typedef {import("./types.js").RecordingEpisodes} RecordingEpisodes */
/** @typedef {"success" | "failure" | "discard" | "none"} Judgement */

/** Judgements of earlier episodes by others are in no status: they are looked for so often. */
const EVERY_MS = 3000;
const MAX_ROWS = 200;
const NONE = "No episodes. E starts one while a recording goes on.";

/** @type {Record<Judgement, string>} */
const BUTTONS = { success: "Success", failure: "Failure", discard: "Discard", none: "No judgement" };

export class EpisodesPanel {
  element = make("section", "episodes");
  #summary = make("p", "");
  #error = make("p", "said");
  #list = make("ul", "");
  #older = make("p", "quiet");
  /** @type {Status | null} */
  #status = null;
  #isOpen = false;
  #isAsking = false;
  #askedFor = "";
  #askedAt = -Infinity;
  /** What the list shows. */
  #built = "";

  constructor() {
    this.#error.setAttribute("role", "alert");
    this.element.append(this.#summary, this.#error, this.#list, this.#older);
  }

  open() {
    this.#isOpen = true;
    this.look();
  }

  close() {
    this.#isOpen = false;
  }

  /** They changed: asks for them. */
  look() {
    this.#askedFor = "";
    void this.#ask();
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    void this.#ask();
  }

  get #isRecording() {
    const recording = this.#status?.recording ?? null;
    return recording !== null && recording.active && !recording.closing;
  }

  async #ask() {
    const recording = this.#status?.recording ?? null;
    const { path, episodes, episodes_discarded: discarded, episode } = recording ?? {};
    const wanted = JSON.stringify([path, episodes, discarded, episode, this.#isRecording]);
    const now = performance.now();
    const isDue = wanted !== this.#askedFor || (this.#isRecording && now - this.#askedAt > EVERY_MS);
    if (!this.#isOpen || this.#isAsking || !isDue) {
      return;
    }
    this.#isAsking = true;
    this.#askedAt = now;
    try {
      const of = /** @type {RecordingEpisodes | null} */ (await get("/v1/episodes"));
      this.#askedFor = wanted;
      this.#show(of);
    } catch {
      // The connection says so when the daemon has gone; it is asked again with the next status.
    } finally {
      this.#isAsking = false;
    }
  }

  /** @param {RecordingEpisodes | null} of */
  #show(of) {
    const built = JSON.stringify([of, this.#isRecording]);
    if (built === this.#built) {
      return;
    }
    this.#built = built;
    const recording = this.#status?.recording ?? null;
    const all = of?.episodes ?? [];
    const name = recording === null ? "" : recording.name || recording.path;
    setText(this.#summary, all.length === 0 || recording === null ? NONE : `${name}: ${countsText(recording)}`);
    const rows = all.slice(-MAX_ROWS).reverse().map((episode) => this.#row(episode));
    const focused = document.activeElement?.getAttribute("aria-label") ?? "";
    this.#list.replaceChildren(...rows);
    // The button that was pressed is another one now.
    const again = [...this.#list.querySelectorAll("button")].find((b) => b.getAttribute("aria-label") === focused);
    again?.focus();
    setText(this.#older, all.length > MAX_ROWS ? `${all.length - MAX_ROWS} earlier ones: depthrig info` : "");
  }

  /** @param {Episode} episode */
  #row(episode) {
    const row = make("li", "episode-row");
    const state = episodeState(episode);
    setState(row, state);
    row.dataset.number = String(episode.number);
    const head = make("div", "recording-head");
    const title = [`Episode ${episode.number}`, lengthText(episode, null)].filter((part) => part !== "").join(" · ");
    head.append(makeText("strong", "", title), makeText("span", "health", EPISODE_TEXT[state]));
    row.append(head, makeText("p", "episode-task", episode.task));
    if (this.#isRecording && state !== "running") {
      const buttons = make("div", "buttons");
      for (const judgement of /** @type {Judgement[]} */ (Object.keys(BUTTONS))) {
        const button = makeButton(BUTTONS[judgement], () => void this.#judge(episode.number, judgement));
        const isNow = judgement === (state === "discarded" ? "discard" : state === "kept" ? "none" : state);
        button.setAttribute("aria-pressed", String(isNow));
        button.setAttribute("aria-label", `${BUTTONS[judgement]}: episode ${episode.number}`);
        buttons.append(button);
      }
      row.append(buttons);
    }
    return row;
  }

  /**
   * @param {number} number
   * @param {Judgement} judgement
   */
  async #judge(number, judgement) {
    setText(this.#error, "");
    const outcome = judgement === "none" ? null : judgement;
    try {
      const request = judgement === "discard" ? { action: "discard", number } : { action: "mark", outcome, number };
      await post("/v1/episode", request);
      this.look();
    } catch (error) {
      setText(this.#error, messageOf(error));
    }
  }
}
