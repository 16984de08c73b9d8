/** Signals of a robot: what their numbers say, and the lines of their plots. Pure functions and classes. */

import { age } from "./words.js";

/** @typedef {import("./types.js").SignalStatus} SignalStatus */
/** @typedef {import("./types.js").SignalNews} SignalNews */
/** @typedef {import("./types.js").SignalField} SignalField */
/** @typedef {import("./types.js").SignalPoint} SignalPoint */
/** @typedef {import("./types.js").SignalElement} SignalElement */
/** @typedef {"live" | "silent" | "failed" | "waiting"} SignalLook */
/** @typedef {{label: string, unit: string, text: string, line: number}} SignalValue `line` is -1 for one that is not plotted */
/** @typedef {{low: number, high: number}} Span */

export const PLOT_MS = 10_000;
/** Lines of a plot, as many as the daemon sends. */
export const MAX_LINES = 32;
/** As many as the daemon keeps, and as much again for those that came while one of them was written. */
const MAX_POINTS = 400;
const PLOTTED = ["f64", "f32", "i64"];

/**
 * Those that the status lists, then others that are published: a replay's status lists none.
 *
 * @param {readonly SignalStatus[]} known
 * @param {readonly string[]} published
 * @returns {string[]}
 */
export function namesOf(known, published) {
  const names = known.map(({ signal }) => signal);
  return [...names, ...published.filter((name) => !names.includes(name))];
}

/**
 * @param {SignalStatus | undefined} status
 * @param {SignalNews | undefined} news
 * @returns {SignalLook}
 */
export function lookOf(status, news) {
  const isFault = status !== undefined && status.required && status.state !== "live";
  if (isFault || (news?.problem ?? null) !== null) {
    return "failed";
  }
  if (status?.state === "silent") {
    return "silent";
  }
  return (status?.age_s ?? news?.age_s ?? null) === null ? "waiting" : "live";
}

/**
 * What is wrong, and what to do; empty if nothing is.
 *
 * @param {SignalStatus | undefined} status
 * @param {SignalNews | undefined} news
 */
export function faultText(status, news) {
  const problem = news?.problem ?? null;
  if (problem !== null) {
    return problem;
  }
  if (status === undefined || status.state === "live") {
    return "";
  }
  const recordings = status.required ? " The rig requires it: no recording begins without it." : "";
  if (status.state === "missing") {
    return `Nobody publishes it. Start the program that does.${recordings}`;
  }
  const silence = age((status.age_s ?? 0) * 1000);
  return `Silent for ${silence}. Look whether the program that publishes it hangs or has ended.${recordings}`;
}

/**
 * "50.0 Hz · 12 ms · 1234 samples · 3 lost · rad".
 *
 * @param {SignalStatus | undefined} status
 * @param {SignalNews | undefined} news
 */
export function numbersText(status, news) {
  const ageS = news?.age_s ?? status?.age_s ?? null;
  const rate = news?.rate_hz ?? null;
  const units = new Set((news?.fields ?? []).map(({ unit }) => unit ?? "").filter((unit) => unit !== ""));
  const parts = [
    rate === null ? "" : `${rate.toFixed(rate < 100 ? 1 : 0)} Hz`,
    ageS === null ? "" : age(ageS * 1000),
    [...units].join(", "),
    status === undefined ? "" : `${status.samples} samples`,
    status === undefined ? "" : `${status.missed} lost`,
    (news?.restarts ?? 0) === 0 ? "" : `published anew ${news?.restarts}×`,
    status?.required ? "required" : "",
  ];
  return parts.filter((part) => part !== "").join(" · ");
}

/**
 * @param {SignalElement} element
 * @param {SignalField["type"]} type
 */
export function elementText(element, type) {
  if (typeof element === "number") {
    const size = Math.abs(element);
    const isOdd = size >= 1e6 || (size < 1e-3 && size > 0);
    return type === "i64" ? String(element) : isOdd ? element.toExponential(3) : element.toFixed(4);
  }
  return element === null ? "not a number" : typeof element === "boolean" ? (element ? "yes" : "no") : element;
}

/**
 * The newest values, by the names of their fields.
 *
 * @param {readonly SignalField[]} fields
 * @param {readonly (readonly SignalElement[])[]} values
 * @returns {SignalValue[]}
 */
export function valuesOf(fields, values) {
  let line = 0;
  return fields.flatMap(({ name, type, unit = "", count = 1 }, at) => {
    const isPlotted = PLOTTED.includes(type);
    const first = line;
    line += isPlotted ? count : 0;
    return (values[at] ?? []).map((element, i) => ({
      label: count > 1 ? `${name}[${i}]` : name,
      unit,
      text: elementText(element, type),
      line: isPlotted && first + i < MAX_LINES ? first + i : -1,
    }));
  });
}

/**
 * Elements that are not shown.
 *
 * @param {readonly SignalField[]} fields
 * @param {readonly (readonly SignalElement[])[]} values
 */
export function restOf(fields, values) {
  const all = fields.reduce((sum, { count = 1 }) => sum + count, 0);
  return all - values.reduce((sum, elements) => sum + elements.length, 0);
}

/** @param {number} line */
export function lineColor(line) {
  // The golden angle: neighbours differ, however many there are.
  return `hsl(${Math.round(210 + line * 137.508) % 360} 75% 68%)`;
}

/** The last seconds of a signal. */
export class Trace {
  /** @type {SignalPoint[]} */
  points = [];
  /** Of the last point, however old; 0 before the first. */
  number = 0;

  /** @param {readonly SignalPoint[]} news */
  add(news) {
    for (const point of news) {
      const before = this.points.at(-1);
      if (before !== undefined && (point.ms < before.ms || point.values.length !== before.values.length)) {
        // A replay that went back, or a publisher with another clock or other fields.
        this.points = [];
      }
      this.points.push(point);
      this.number = point.number;
    }
    const from = this.end - PLOT_MS;
    const old = this.points.findIndex(({ ms }) => ms >= from);
    this.points.splice(0, Math.max(old, this.points.length - MAX_POINTS));
  }

  /** A daemon that began anew numbers its points anew. */
  clear() {
    this.points = [];
    this.number = 0;
  }

  get end() {
    return this.points.at(-1)?.ms ?? 0;
  }

  /**
   * Least and greatest value of all lines, some room apart; `null` without one.
   *
   * @returns {Span | null}
   */
  get span() {
    const all = this.points.flatMap(({ values }) => values).filter((value) => value !== null);
    if (all.length === 0) {
      return null;
    }
    const low = all.reduce((least, value) => Math.min(least, value), Infinity);
    const high = all.reduce((most, value) => Math.max(most, value), -Infinity);
    const room = high > low ? (high - low) * 0.05 : Math.max(Math.abs(high) * 0.05, 1e-6);
    return { low: low - room, high: high + room };
  }

  /**
   * Each line in pieces, without its gaps; x and y are shares of the plot, y from above.
   *
   * @param {Span} span
   * @returns {{x: number, y: number}[][][]}
   */
  lines({ low, high }) {
    const count = this.points[0]?.values.length ?? 0;
    return Array.from({ length: count }, (_, line) => {
      /** @type {{x: number, y: number}[][]} */
      const pieces = [];
      let isOpen = false;
      for (const { ms, gap, values } of this.points) {
        const value = values[line];
        if (value === null) {
          isOpen = false;
          continue;
        }
        const place = { x: 1 - (this.end - ms) / PLOT_MS, y: (high - value) / (high - low) };
        const piece = isOpen && !gap ? pieces.at(-1) : undefined;
        if (piece === undefined) {
          pieces.push([place]);
        } else {
          piece.push(place);
        }
        isOpen = true;
      }
      return pieces;
    });
  }
}
