/** Small helpers for the document. */

/**
 * The element with this id, of the class that the caller relies on.
 *
 * @template {Element} T
 * @param {string} id
 * @param {new () => T} type
 * @returns {T}
 */
export function byId(id, type) {
  const element = document.getElementById(id);
  if (!(element instanceof type)) {
    throw new Error(`index.html has no ${type.name} with the id ${id}`);
  }
  return element;
}

/**
 * Sets text only when it differs: an unchanged live region is not read aloud again, and nothing is laid out.
 *
 * @param {Element} element
 * @param {string} text
 */
export function setText(element, text) {
  if (element.textContent !== text) {
    element.textContent = text;
  }
}

/**
 * Sets `data-state` only when it differs.
 *
 * @param {HTMLElement} element
 * @param {string} state
 */
export function setState(element, state) {
  if (element.dataset.state !== state) {
    element.dataset.state = state;
  }
}

/**
 * An element with a class.
 *
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {string} className
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(tag, className) {
  const element = document.createElement(tag);
  element.className = className;
  return element;
}

/**
 * An element with a class and a text.
 *
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {string} className
 * @param {string} text
 * @returns {HTMLElementTagNameMap[K]}
 */
export function makeText(tag, className, text) {
  const element = make(tag, className);
  element.textContent = text;
  return element;
}

/**
 * @param {string} text
 * @param {() => void} onClick
 */
export function makeButton(text, onClick) {
  const button = makeText("button", "", text);
  button.type = "button";
  button.addEventListener("click", onClick);
  return button;
}

/**
 * Reads aloud what changed, for those who do not see the colour change.
 *
 * @param {string} text
 */
export function announce(text) {
  byId("announce", HTMLElement).textContent = text;
}

/**
 * Gives the focus back after a click with a pointer: otherwise Space, which starts and stops a recording, would
 * press the same button again. A button that was reached by keyboard keeps it.
 */
export function releaseFocusAfterClicks() {
  document.addEventListener("click", (event) => {
    const isPointer = event.detail > 0;
    const focused = document.activeElement;
    if (isPointer && focused instanceof HTMLElement && focused.matches("button, input[type=checkbox]")) {
      focused.blur();
    }
    // Before the button acts: a panel or a dialog that it opens gives the focus back when it is closed.
  }, { capture: true });
}

/**
 * A value kept over visits. A browser may refuse storage; the page goes on without it.
 *
 * @param {string} key
 * @returns {string | null}
 */
export function stored(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

/**
 * @param {string} key
 * @param {string} value
 */
export function store(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // Without storage the value lasts until the page is closed.
  }
}
