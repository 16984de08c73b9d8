/** The panel of the synchronisation: how far each stream lies from its set, and the cameras from each other. */

import { make, makeText, setState, setText } from "./dom.js";
import { pairSkews, signedMs, streamOfEach, streamSkews } from "./skew.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./skew.js").SkewState} SkewState */

/** @type {Record<SkewState, string>} */
const STATE_TEXT = { good: "good", wide: "wide", out: "outside", none: "no set" };

export class SyncPanel {
  element = make("section", "sync");
  #summary = make("p", "");
  #streams = make("tbody", "");
  #pairs = make("table", "pairs");
  /** The cameras that the table was built for. */
  #built = "";

  constructor() {
    const table = make("table", "");
    table.append(makeText("caption", "", "Streams: distance of the capture from the tick of its set, ms"));
    table.append(headRow(["Stream", "Median", "95 %", "Window", ""]), this.#streams);
    const legend = "Window: a frame further from the tick is in no set. Wide: the median is beyond half of it.";
    this.element.append(this.#summary, table, this.#pairs, makeText("p", "quiet", legend));
  }

  open() {}

  close() {}

  /** @param {Status} status */
  update(status) {
    const { sets } = status;
    const spread = `spread ${sets.spread_p50_ms.toFixed(1)} ms, 95 % within ${(sets.spread_p95_ms ?? 0).toFixed(1)} ms`;
    const counts = `${sets.sent} sets at ${sets.nominal_hz} Hz, ${sets.incomplete} incomplete`;
    setText(this.#summary, sets.sent === 0 ? "No set yet." : `${counts}; ${spread}`);
    const skews = streamSkews(status);
    const cameras = streamOfEach(status);
    const built = JSON.stringify([skews.map(({ stream }) => stream), cameras]);
    if (built !== this.#built) {
      this.#built = built;
      this.#build(skews.map(({ stream }) => stream), cameras);
    }
    skews.forEach((skew, i) => {
      const cells = this.#streams.rows[i].cells;
      setText(cells[1], signedMs(skew.medianMs));
      setText(cells[2], skew.p95Ms === null ? "–" : skew.p95Ms.toFixed(1));
      setText(cells[3], Number.isFinite(skew.windowMs) ? `±${skew.windowMs.toFixed(1)}` : "–");
      setText(cells[4], STATE_TEXT[skew.state]);
      setState(this.#streams.rows[i], skew.state);
    });
    pairSkews(skews, cameras).forEach((row, y) =>
      row.forEach((pair, x) => {
        if (x !== y) {
          const cell = this.#pairs.tBodies[0].rows[y].cells[x + 1];
          setText(cell, signedMs(pair.ms));
          setState(cell, pair.state);
        }
      }),
    );
  }

  /**
   * @param {string[]} streams
   * @param {string[]} cameras
   */
  #build(streams, cameras) {
    this.#streams.replaceChildren(...streams.map((stream) => bodyRow(stream, 4)));
    const body = make("tbody", "");
    body.append(...cameras.map((stream) => bodyRow(stream, cameras.length)));
    const caption = "Cameras: how much later the column is than the row, ms";
    const head = headRow(["", ...cameras.map((stream) => stream.split("/")[0])]);
    this.#pairs.replaceChildren(makeText("caption", "", caption), head, body);
    this.#pairs.hidden = cameras.length < 2;
  }
}

/** @param {string[]} names */
export function headRow(names) {
  const head = make("thead", "");
  const row = make("tr", "");
  row.append(
    ...names.map((name) => {
      const cell = makeText(name === "" ? "td" : "th", "", name);
      if (name !== "") {
        cell.setAttribute("scope", "col");
      }
      return cell;
    }),
  );
  head.append(row);
  return head;
}

/**
 * @param {string} name
 * @param {number} cells
 */
function bodyRow(name, cells) {
  const row = make("tr", "");
  const head = makeText("th", "", name);
  head.scope = "row";
  row.append(head, ...Array.from({ length: cells }, () => make("td", "")));
  return row;
}
