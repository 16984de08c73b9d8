/** A camera's control in words: pure functions. */

/** @typedef {import("./paneltypes.js").Control} Control */
/** @typedef {import("./paneltypes.js").ControlValue} ControlValue */

/**
 * @param {Control} control
 * @param {ControlValue | null | undefined} value
 */
export function valueText(control, value) {
  if (value === null || value === undefined) {
    return "";
  }
  if (typeof value === "boolean") {
    return value ? "on" : "off";
  }
  const item = control.items?.find((one) => one.value === value);
  return item?.name ?? String(value);
}

/** @param {Control} control */
export function controlFacts(control) {
  const { minimum, maximum, step, kind } = control;
  const range = kind === "integer" ? `${minimum} to ${maximum}${step !== undefined && step > 1 ? ` in steps of ${step}` : ""}` : "";
  const usual = valueText(control, control.default);
  const inFile = valueText(control, control.in_file);
  return [range, usual && `default ${usual}`, inFile ? `rig file ${inFile}` : "not in the rig file"].filter(Boolean).join(" · ");
}

/**
 * Why a control cannot be set now; empty if it can.
 *
 * @param {Control} control
 */
export function whyNotSet(control) {
  if (control.is_read_only) {
    return "The camera only reports it.";
  }
  return control.is_active ? "" : "Inactive: another control decides it now, such as an automatic one.";
}

/** @param {Control} control */
export function differsFromFile(control) {
  return control.in_file !== null && control.in_file !== undefined && control.in_file !== control.value;
}

/**
 * Lines of a difference with what they are.
 *
 * @param {string} diff
 * @returns {{kind: "added" | "removed" | "place" | "same", text: string}[]}
 */
export function diffLines(diff) {
  return diff
    .replace(/\n$/, "")
    .split("\n")
    .map((text) => {
      if (text.startsWith("+++") || text.startsWith("---") || text.startsWith("@@")) {
        return { kind: "place", text };
      }
      return { kind: text.startsWith("+") ? "added" : text.startsWith("-") ? "removed" : "same", text };
    });
}
