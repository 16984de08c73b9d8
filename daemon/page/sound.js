/** Sounds for those who look at the scene and not at the screen. Off until the first click or key. */

import { byId, setText, store, stored } from "./dom.js";

/** @typedef {"start" | "stop" | "error" | "loss" | "count" | "mark"} Cue */
/** @typedef {{hz: number, startS: number, lengthS: number, shape: OscillatorType}} Tone */

const MUTE_KEY = "depthrig-mute";
const VOLUME = 0.15;

/** @type {Record<Cue, Tone[]>} */
const CUES = {
  start: [
    { hz: 523, startS: 0, lengthS: 0.12, shape: "sine" },
    { hz: 784, startS: 0.13, lengthS: 0.2, shape: "sine" },
  ],
  stop: [
    { hz: 784, startS: 0, lengthS: 0.12, shape: "sine" },
    { hz: 392, startS: 0.13, lengthS: 0.25, shape: "sine" },
  ],
  error: [
    { hz: 196, startS: 0, lengthS: 0.2, shape: "square" },
    { hz: 196, startS: 0.28, lengthS: 0.3, shape: "square" },
  ],
  count: [{ hz: 660, startS: 0, lengthS: 0.1, shape: "sine" }],
  mark: [{ hz: 988, startS: 0, lengthS: 0.08, shape: "sine" }],
  loss: [{ hz: 1175, startS: 0, lengthS: 0.08, shape: "triangle" }],
};

/** @type {AudioContext | null} */
let audio = null;
let isMuted = stored(MUTE_KEY) === "1";

/** @param {Cue} cue */
export function play(cue) {
  if (audio === null || isMuted) {
    return;
  }
  for (const tone of CUES[cue]) {
    const oscillator = audio.createOscillator();
    const gain = audio.createGain();
    const start = audio.currentTime + tone.startS;
    const end = start + tone.lengthS;
    oscillator.type = tone.shape;
    oscillator.frequency.value = tone.hz;
    gain.gain.setValueAtTime(VOLUME, start);
    // A tone that ends at once clicks.
    gain.gain.exponentialRampToValueAtTime(0.001, end);
    oscillator.connect(gain).connect(audio.destination);
    oscillator.start(start);
    oscillator.stop(end);
  }
}

/** Wires the mute button, and the sound once the browser permits it. */
export function setUpSound() {
  const button = byId("mute", HTMLButtonElement);
  const show = () => {
    button.setAttribute("aria-pressed", String(isMuted));
    setText(button, isMuted ? "Sound off" : "Sound on");
  };
  button.addEventListener("click", () => {
    isMuted = !isMuted;
    store(MUTE_KEY, isMuted ? "1" : "0");
    show();
  });
  const unlock = () => {
    audio ??= new AudioContext();
  };
  // While capturing: the first key may be the one that starts a recording, and its sound comes right after.
  document.addEventListener("pointerdown", unlock, { once: true, capture: true });
  document.addEventListener("keydown", unlock, { once: true, capture: true });
  show();
}
