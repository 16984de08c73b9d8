/** The WebSocket `/v1/live`: token, reconnecting, and who gets which message. */

import { socketAddress } from "./dataset.js";
import { CLOSED, PROTOCOL, parseImage, parseText } from "./protocol.js";
import { creditMessage, pixelMessage, replayMessage, signalsMessage, tokenMessage, watchMessage } from "./protocol.js";

/** @typedef {import("./types.js").Hello} Hello */
/** @typedef {import("./types.js").Status} Status */
/** @typedef {import("./types.js").Image} Image */
/** @typedef {import("./types.js").PixelAnswer} PixelAnswer */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./types.js").Measure} Measure */
/** @typedef {"connecting" | "live" | "lost" | "denied"} ConnectionState */

/**
 * @typedef {Object} Listener
 * @property {(state: ConnectionState, text: string) => void} onState
 * @property {(hello: Hello) => void} onHello
 * @property {(status: Status) => void} onStatus
 * @property {(image: Image, credit: () => void) => void} onImage `credit` must be called once, drawn or ignored
 * @property {(answer: PixelAnswer) => void} onPixel
 * @property {(geometry: Geometry) => void} onGeometry
 * @property {(measure: Measure) => void} onMeasure
 * @property {(news: import("./types.js").SignalsNews) => void} onSignals
 * @property {(message: string) => void} onProblem
 */

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 5000;

/** The status comes twice a second: a connection that says nothing for so long is dead, though TCP may not know. */
const SILENCE_MS = 5000;
/** Opening a dataset takes as long as its disk needs. */
const OPENING_MS = 20_000;

const DENIED_TEXT = "This page needs a token. Run “depthrig open” and use the address that it prints.";
const WRONG_TOKEN_TEXT =
  "The token of this page is not valid. Run “depthrig open” and use the address that it prints.";
const LOST_TEXT = "The daemon does not answer; it is tried again.";

export class Connection {
  /** @type {WebSocket | null} */
  #socket = null;
  #token = "";
  /** @type {string | null} the dataset that is shown instead of the live rig */
  #dataset = null;
  #pauseMs = FIRST_PAUSE_MS;
  #retryTimer = 0;
  #silenceTimer = 0;
  #watchNumber = 0;
  #isLive = false;
  /** @type {Listener} */
  #listener;

  /** @param {Listener} listener */
  constructor(listener) {
    this.#listener = listener;
  }

  get isLive() {
    return this.#isLive;
  }

  /**
   * @param {string | null} token
   * @param {string | null} dataset to show; `null`: the live rig
   */
  open(token, dataset) {
    this.#dataset = dataset;
    clearTimeout(this.#retryTimer);
    this.#drop();
    if (token === null || token === "") {
      this.#listener.onState("denied", DENIED_TEXT);
      return;
    }
    this.#token = token;
    this.#pauseMs = FIRST_PAUSE_MS;
    this.#listener.onState("connecting", "Connecting to the daemon.");
    this.#connect();
  }

  /**
   * Asks for these streams and no others.
   *
   * @param {import("./types.js").Watch[]} watched
   * @returns {number} the number that the images of this message carry; 0 while there is no connection
   */
  watch(watched) {
    if (!this.#isLive) {
      return 0;
    }
    this.#send(watchMessage(watched));
    this.#watchNumber += 1;
    return this.#watchNumber;
  }

  /**
   * @param {number} id
   * @param {import("./types.js").Place} place
   */
  askPixel(id, place) {
    this.#send(pixelMessage(id, place));
  }

  /**
   * @param {import("./types.js").ShownSignal[] | null} shown
   * @returns {boolean} whether it was sent
   */
  askSignals(shown) {
    if (this.#isLive) {
      this.#send(signalsMessage(shown));
    }
    return this.#isLive;
  }

  /**
   * Steers the dataset that is shown.
   *
   * @param {string} command
   * @param {Record<string, unknown>} body
   */
  steer(command, body) {
    this.#send(replayMessage(command, body));
  }

  #connect() {
    const socket = new WebSocket(socketAddress(location, this.#dataset));
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#watchNumber = 0;
    this.#hearSilence(socket);
    socket.addEventListener("open", () => this.#send(tokenMessage(this.#token)));
    socket.addEventListener("message", (event) => {
      if (socket === this.#socket) {
        this.#hearSilence(socket);
        this.#receive(socket, event.data);
      }
    });
    socket.addEventListener("close", (event) => {
      if (socket === this.#socket) {
        this.#closed(event.code, event.reason);
      }
    });
  }

  /**
   * @param {WebSocket} socket
   * @param {string | ArrayBuffer} data
   */
  #receive(socket, data) {
    if (typeof data !== "string") {
      const credit = () => {
        // Credits of a connection that has ended must not reach the one after it.
        if (socket === this.#socket) {
          this.#send(creditMessage());
        }
      };
      this.#receiveImage(data, credit);
      return;
    }
    const message = parseText(data);
    if (message === null) {
      return;
    }
    if ("hello" in message) {
      this.#welcome(message.hello);
    } else if ("status" in message) {
      this.#listener.onStatus(message.status);
    } else if ("pixel" in message) {
      this.#listener.onPixel(message.pixel);
    } else if ("geometry" in message) {
      this.#listener.onGeometry(message.geometry);
    } else if ("measure" in message) {
      this.#listener.onMeasure(message.measure);
    } else if ("signals" in message) {
      this.#listener.onSignals(message.signals);
    } else {
      this.#listener.onProblem(message.problem.message);
    }
  }

  /**
   * @param {ArrayBuffer} data
   * @param {() => void} credit
   */
  #receiveImage(data, credit) {
    /** @type {Image} */
    let image;
    try {
      image = parseImage(data);
    } catch (error) {
      // An image that cannot be read must not keep its credit: four of them would stop the page.
      credit();
      this.#listener.onProblem(error instanceof Error ? error.message : String(error));
      return;
    }
    this.#listener.onImage(image, credit);
  }

  /** @param {Hello} hello */
  #welcome(hello) {
    if (hello.protocol !== PROTOCOL) {
      this.#drop();
      this.#listener.onHello(hello);
      const text = `The daemon speaks protocol ${hello.protocol}, this page ${PROTOCOL}. Reload the page.`;
      this.#listener.onState("lost", text);
      return;
    }
    this.#isLive = true;
    this.#pauseMs = FIRST_PAUSE_MS;
    this.#listener.onHello(hello);
    this.#listener.onState("live", "Connected");
  }

  /**
   * @param {number} code
   * @param {string} reason
   */
  #closed(code, reason) {
    this.#drop();
    if (code === CLOSED.DENIED) {
      this.#listener.onState("denied", WRONG_TOKEN_TEXT);
      return;
    }
    let text = LOST_TEXT;
    if (code === CLOSED.NOT_SHOWN) {
      text = `This dataset is not shown: ${reason}`;
    } else if (code === CLOSED.TOO_MANY_PAGES) {
      text = "Too many pages of this rig are open; close one. It is tried again.";
    } else if (code === CLOSED.MISUNDERSTOOD) {
      text = `The daemon did not understand this page: ${reason}. It is tried again.`;
    }
    this.#listener.onState("lost", text);
    const pause = this.#pauseMs;
    this.#pauseMs = Math.min(LONGEST_PAUSE_MS, pause * 2);
    // The text stays while it is tried: a line that flickers twice a second cannot be read.
    this.#retryTimer = setTimeout(() => this.#connect(), pause);
  }

  /** @param {WebSocket} socket */
  #hearSilence(socket) {
    const isOpening = this.#dataset !== null && !this.#isLive;
    clearTimeout(this.#silenceTimer);
    this.#silenceTimer = setTimeout(() => {
      if (socket === this.#socket) {
        this.#closed(0, "");
      }
    }, isOpening ? OPENING_MS : SILENCE_MS);
  }

  #drop() {
    clearTimeout(this.#silenceTimer);
    const socket = this.#socket;
    this.#socket = null;
    this.#isLive = false;
    socket?.close();
  }

  /** @param {string} text */
  #send(text) {
    if (this.#socket?.readyState === WebSocket.OPEN) {
      this.#socket.send(text);
    }
  }
}
