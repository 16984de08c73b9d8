/** The panel of the robot's signals. It asks for their values while it is shown, and for the next ones when it has drawn the last. */

import { make, makeText, setState, setText } from "./dom.js";
import { Trace, faultText, lineColor, lookOf, namesOf, numbersText, restOf, valuesOf } from "./signals.js";

/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").SignalsNews} SignalsNews */
/** @typedef {import("./types.js").SignalNews} SignalNews */
/** @typedef {import("./types.js").ShownSignal} ShownSignal */

const ASK_EVERY_MS = 100;
/** Longer names take a line of their own. */
const LONG_LABEL = 13;
/** An answer that does not come for so long is lost. */
const LOST_MS = 3000;
const MAX_SHOWN = 64;
const NONE = "No signals. A robot's program publishes them with depthrig.Signal: docs/signals.md.";

/** One signal. */
class Card {
  element = make("section", "signal");
  trace = new Trace();
  /** @type {SignalNews | undefined} */
  news;
  #numbers = make("p", "signal-numbers");
  #fault = make("p", "signal-fault");
  #plot = make("canvas", "");
  #scale = make("p", "signal-scale quiet");
  #values = make("dl", "signal-values");
  #rest = make("p", "quiet");
  /** The fields that the list was built for. */
  #built = "";

  /** @param {string} name */
  constructor(name) {
    this.element.dataset.signal = name;
    this.#plot.setAttribute("role", "img");
    this.#plot.setAttribute("aria-label", `The last 10 s of ${name}`);
    this.element.append(makeText("h3", "", name), this.#numbers, this.#fault, this.#plot, this.#scale);
    this.element.append(this.#values, this.#rest);
  }

  /** @param {import("./types.js").SignalStatus | undefined} status */
  show(status) {
    setState(this.element, lookOf(status, this.news));
    setText(this.#numbers, numbersText(status, this.news));
    setText(this.#fault, faultText(status, this.news));
    const fields = this.news?.fields ?? [];
    const values = this.news?.values ?? [];
    this.#showValues(valuesOf(fields, values));
    const rest = restOf(fields, values);
    setText(this.#rest, rest > 0 && values.length > 0 ? `${rest} more` : "");
    this.#draw();
  }

  /** @param {import("./signals.js").SignalValue[]} values */
  #showValues(values) {
    const built = JSON.stringify(values.map(({ label, line }) => [label, line]));
    if (built !== this.#built) {
      this.#built = built;
      this.#values.classList.toggle("is-long", values.some(({ label }) => label.length > LONG_LABEL));
      this.#values.replaceChildren(
        ...values.map(({ label, line }) => {
          const row = make("div", "");
          const name = makeText("dt", "", label);
          if (line >= 0) {
            const swatch = make("span", "swatch");
            swatch.style.background = lineColor(line);
            name.prepend(swatch);
          }
          row.append(name, make("dd", ""));
          return row;
        }),
      );
    }
    values.forEach(({ text, unit }, i) => {
      setText(/** @type {Element} */ (this.#values.children[i].lastElementChild), unit === "" ? text : `${text} ${unit}`);
    });
  }

  #draw() {
    const { span } = this.trace;
    this.#plot.hidden = span === null;
    this.#scale.hidden = span === null;
    if (span === null) {
      return;
    }
    setText(this.#scale, `last 10 s, ${span.low.toPrecision(3)} to ${span.high.toPrecision(3)}`);
    const canvas = this.#plot;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * devicePixelRatio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * devicePixelRatio));
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    context.lineWidth = 1.5 * devicePixelRatio;
    context.lineJoin = "round";
    this.trace.lines(span).forEach((pieces, line) => {
      context.strokeStyle = lineColor(line);
      context.fillStyle = context.strokeStyle;
      for (const piece of pieces) {
        context.beginPath();
        piece.forEach(({ x, y }) => context.lineTo(x * canvas.width, y * canvas.height));
        context.stroke();
        if (piece.length === 1) {
          const size = context.lineWidth * 2;
          context.fillRect(piece[0].x * canvas.width - size, piece[0].y * canvas.height - size / 2, size, size);
        }
      }
    });
  }
}

export class SignalsPanel {
  element = make("section", "signals");
  #none = makeText("p", "quiet", NONE);
  /** @type {Map<string, Card>} */
  #cards = new Map();
  /** @type {Status | null} */
  #status = null;
  /** @type {string[]} */
  #published = [];
  #isOpen = false;
  #timer = 0;
  /** When it was asked; -Infinity: no answer is awaited. */
  #askedAt = -Infinity;
  #ask;

  /** @param {(shown: ShownSignal[] | null) => boolean} ask returns whether it was sent; `null`: none is shown any more */
  constructor(ask) {
    this.#ask = ask;
    this.element.append(this.#none);
    document.addEventListener("visibilitychange", () => this.#isOpen && this.#begin());
  }

  open() {
    this.#isOpen = true;
    this.#begin();
  }

  close() {
    this.#isOpen = false;
    clearTimeout(this.#timer);
    this.#ask(null);
  }

  /** The connection is another one, whose daemon knows nothing of what this page has. */
  reconnected() {
    this.#cards.forEach((card) => card.trace.clear());
    if (this.#isOpen) {
      this.#begin();
    }
  }

  /** @param {Status} status */
  update(status) {
    this.#status = status;
    this.#show();
  }

  /** @param {SignalsNews} news */
  answer(news) {
    this.#askedAt = -Infinity;
    if (!this.#isOpen || document.hidden) {
      return;
    }
    this.#published = news.published;
    for (const signal of news.signals) {
      const card = this.#cards.get(signal.signal);
      if (card !== undefined) {
        card.news = signal;
        card.trace.add(signal.points);
      }
    }
    this.#show();
  }

  #begin() {
    clearTimeout(this.#timer);
    this.#askedAt = -Infinity;
    if (document.hidden) {
      this.#ask(null);
    } else {
      this.#next();
    }
  }

  #next() {
    const now = performance.now();
    if (now - this.#askedAt > LOST_MS) {
      const names = namesOf(this.#status?.signals ?? [], this.#published).slice(0, MAX_SHOWN);
      const shown = names.map((signal) => ({ signal, after: this.#cards.get(signal)?.trace.number ?? 0 }));
      this.#askedAt = this.#ask(shown) ? now : -Infinity;
    }
    this.#timer = setTimeout(() => this.#next(), ASK_EVERY_MS);
  }

  #show() {
    if (!this.#isOpen) {
      return;
    }
    const known = this.#status?.signals ?? [];
    const names = namesOf(known, this.#published).slice(0, MAX_SHOWN);
    this.#none.hidden = names.length > 0 || this.#status === null;
    for (const name of this.#cards.keys()) {
      if (!names.includes(name)) {
        this.#cards.get(name)?.element.remove();
        this.#cards.delete(name);
      }
    }
    names.forEach((name, i) => {
      const card = this.#cards.get(name) ?? new Card(name);
      this.#cards.set(name, card);
      if (this.element.children[i + 1] !== card.element) {
        this.element.insertBefore(card.element, this.element.children[i + 1] ?? null);
      }
      card.show(known.find(({ signal }) => signal === name));
    });
  }
}
