/** Keys of the page: a table, and what is left to the control that has the focus. */

/**
 * @typedef {import("./panels.js").PanelName} PanelName
 *
 * @typedef {Object} KeyTarget what of the focused element matters
 * @property {boolean} isText it takes text
 * @property {boolean} takesSpace Space presses it
 * @property {boolean} takesEnter Enter presses it
 * @property {boolean} takesArrows arrows move it
 * @property {boolean} takesLetters letters choose in it
 * @property {boolean} isInDialog
 *
 * @typedef {{action: "toggleRecord" | "note" | "back" | "help" | "enlarge" | "playPause" | "cloud" | "aids" | "reference"}
 *   | {action: "episode" | "success" | "failure" | "discard" | "task"}
 *   | {action: "redo" | "bad" | "good" | "mark"} | {action: "panel", panel: PanelName}
 *   | {action: "step", sets: number} | {action: "camera", n: number}} KeyAction
 */

/** @type {Record<string, KeyAction>} */
const LETTERS = {
  n: { action: "note" },
  p: { action: "playPause" },
  r: { action: "redo" },
  b: { action: "bad" },
  g: { action: "good" },
  m: { action: "mark" },
  e: { action: "episode" },
  s: { action: "success" },
  f: { action: "failure" },
  x: { action: "discard" },
  t: { action: "task" },
  v: { action: "cloud" },
  a: { action: "aids" },
  o: { action: "reference" },
  l: { action: "panel", panel: "recordings" },
  y: { action: "panel", panel: "sync" },
  d: { action: "panel", panel: "doctor" },
  c: { action: "panel", panel: "controls" },
  k: { action: "panel", panel: "calibration" },
  i: { action: "panel", panel: "signals" },
  j: { action: "panel", panel: "episodes" },
};
const TEXT_INPUTS = ["text", "search", "number", "email", "url", "password", "tel"];

/**
 * @param {EventTarget | null} target
 * @returns {KeyTarget}
 */
export function keyTarget(target) {
  // A dialog that was just closed keeps the focus until the next image of the page is drawn.
  const isLeft = target instanceof HTMLElement && target.closest("dialog:not([open])") !== null;
  const element = target instanceof HTMLElement && !isLeft ? target : null;
  const type = element instanceof HTMLInputElement ? element.type : "";
  const isSelect = element instanceof HTMLSelectElement;
  const isButton = element instanceof HTMLButtonElement;
  const isEditable = element instanceof HTMLTextAreaElement || (element?.isContentEditable ?? false);
  return {
    isText: TEXT_INPUTS.includes(type) || isEditable,
    takesSpace: isButton || isSelect || type === "checkbox",
    takesEnter: isButton || isSelect,
    takesArrows: type === "range" || isSelect,
    takesLetters: isSelect,
    isInDialog: element !== null && element.closest("dialog") !== null,
  };
}

/**
 * The action of a key; `null` when it is not the page's.
 *
 * @param {{key: string, repeat: boolean, ctrlKey: boolean, altKey: boolean, metaKey: boolean}} event
 * @param {KeyTarget} target
 * @returns {KeyAction | null}
 */
export function actionOf(event, target) {
  if (event.ctrlKey || event.altKey || event.metaKey || target.isInDialog) {
    return null;
  }
  if (target.isText) {
    return null;
  }
  const isArrow = event.key === "ArrowLeft" || event.key === "ArrowRight";
  if (isArrow) {
    return target.takesArrows ? null : { action: "step", sets: event.key === "ArrowLeft" ? -1 : 1 };
  }
  // A key that is held, or a pedal that bounces, must not start and stop again and again.
  if (event.repeat) {
    return null;
  }
  if (target.takesLetters && /^[a-z0-9]$/i.test(event.key)) {
    return null;
  }
  if (/^[1-9]$/.test(event.key)) {
    return { action: "camera", n: Number(event.key) };
  }
  switch (event.key) {
    case " ":
      return target.takesSpace ? null : { action: "toggleRecord" };
    case "Enter":
      return target.takesEnter ? null : { action: "enlarge" };
    case "Escape":
      return { action: "back" };
    case "?":
      return { action: "help" };
    default:
      return LETTERS[event.key.toLowerCase()] ?? null;
  }
}
