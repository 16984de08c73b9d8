/** The panel of doctor: findings with why and cure, the USB tree, cameras that are not in the rig. */

import { get, messageOf } from "./api.js";
import { announce, make, makeButton, makeText, setState, setText } from "./dom.js";
import { bySeverity, linkState, linkText, notInRig, usbTree } from "./usbtree.js";
import { size } from "./words.js";

/** @typedef {import("./paneltypes.js").DoctorReport} DoctorReport */
/** @typedef {import("./paneltypes.js").Severity} Severity */

/** It opens cameras that nobody has and writes to the disk. */
const DOCTOR_MS = 60_000;

/** @type {Record<Severity, string>} */
const VERDICT = {
  good: "Nothing was found",
  info: "Nothing speaks against a session",
  warning: "The session runs, but something of it may be lost",
  error: "The session does not run as the rig file has it",
};
/** @type {Record<Severity, string>} */
const GROUP = { error: "Errors", warning: "Warnings", info: "Worth knowing", good: "Good" };

export class DoctorPanel {
  element = make("section", "doctor");
  #again = makeButton("Examine again", () => void this.#examine());
  #progress = document.createElement("progress");
  #said = make("p", "said");
  #report = make("div", "report");
  #isAsking = false;
  #onReport;

  /** @param {(report: DoctorReport) => void} onReport */
  constructor(onReport) {
    this.#onReport = onReport;
    this.#progress.setAttribute("aria-label", "Doctor examines the rig");
    this.#progress.hidden = true;
    this.#said.setAttribute("role", "status");
    const head = make("div", "panel-line");
    head.append(this.#again, this.#progress);
    this.element.append(head, this.#said, this.#report);
  }

  open() {
    void this.#examine();
  }

  close() {}

  async #examine() {
    if (this.#isAsking) {
      return;
    }
    this.#isAsking = true;
    this.#again.disabled = true;
    this.#progress.hidden = false;
    setState(this.element, "asking");
    setText(this.#said, "Examines cameras, USB, disk and memory; this takes some seconds.");
    try {
      const report = /** @type {DoctorReport} */ (await get("/v1/doctor", DOCTOR_MS));
      this.#show(report);
      this.#onReport(report);
      setState(this.element, report.verdict);
      setText(this.#said, `${VERDICT[report.verdict] ?? report.verdict}.`);
      announce(VERDICT[report.verdict] ?? report.verdict);
    } catch (error) {
      setState(this.element, "failed");
      setText(this.#said, `Doctor gave no answer: ${messageOf(error)}`);
    }
    this.#progress.hidden = true;
    this.#again.disabled = false;
    this.#isAsking = false;
  }

  /** @param {DoctorReport} report */
  #show(report) {
    const parts = bySeverity(report.findings).flatMap(({ severity, findings }) => [
      makeText("h3", "", `${GROUP[severity]} (${findings.length})`),
      ...findings.map(finding),
    ]);
    this.#report.replaceChildren(...parts, ...usb(report), ...others(report), ...room(report));
  }
}

/** @param {import("./paneltypes.js").Finding} found */
function finding(found) {
  const box = make("article", "finding");
  setState(box, found.severity);
  const camera = found.camera === null ? "" : `${found.camera}: `;
  box.append(makeText("p", "what", camera + found.what), pair("Why", found.why), pair("Cure", found.cure));
  return box;
}

/**
 * @param {string} word
 * @param {string} text
 */
function pair(word, text) {
  const line = make("p", "pair");
  line.append(makeText("strong", "", `${word}: `), text);
  return line;
}

/** @param {DoctorReport} report */
function usb(report) {
  const tree = usbTree(report);
  if (tree.length === 0) {
    return [makeText("h3", "", "USB"), makeText("p", "quiet", "No camera is attached.")];
  }
  const list = make("ul", "tree");
  for (const { controller, ports } of tree) {
    const item = makeText("li", "", controller);
    const below = make("ul", "");
    below.append(
      ...ports.map((port) => {
        const load = port.loadMbitS > 0 ? `${port.loadMbitS.toFixed(0)} Mbit/s` : "";
        const name = port.camera === null ? "not in the rig" : `camera ${port.camera}`;
        const text = [port.port, port.speed, port.device, name, load, port.use].filter(Boolean).join(" · ");
        const line = makeText("li", "", text);
        line.append(...port.problems.map((problem) => makeText("p", "why", problem)));
        return line;
      }),
    );
    item.append(below);
    list.append(item);
  }
  const links = report.links.map((link) => {
    const line = make("p", "link");
    const meter = document.createElement("meter");
    meter.max = Math.max(link.most_mbit_s, link.load_mbit_s);
    meter.high = link.plan_mbit_s;
    meter.value = link.load_mbit_s;
    meter.setAttribute("aria-label", `Load of ${link.link}`);
    setState(line, linkState(link));
    line.append(meter, linkText(link));
    return line;
  });
  return [makeText("h3", "", "USB"), list, ...links];
}

/** @param {DoctorReport} report */
function others(report) {
  const found = notInRig(report);
  const lines = [
    ...found.map((camera) => `${camera.model} ${camera.serial ?? ""} at ${camera.port}: attached, not in the rig file`),
    ...report.attached.unusable,
    ...report.attached.not_asked,
  ];
  if (lines.length === 0) {
    return [];
  }
  const list = make("ul", "others");
  list.append(...lines.map((line) => makeText("li", "", line)));
  return [makeText("h3", "", "Not in the rig"), list];
}

/** @param {DoctorReport} report */
function room(report) {
  const { disk } = report;
  const rate = `${(disk.needed_bytes_per_s / 1e6).toFixed(0)} MB/s are needed`;
  const measured =
    disk.measured_bytes_per_s === null ? "not measured" : `${(disk.measured_bytes_per_s / 1e6).toFixed(0)} MB/s were measured`;
  const left = disk.minutes_left === null ? "" : `, room for ${Math.floor(disk.minutes_left)} min`;
  const memory = `Shared memory: ${size(report.shm_needed_bytes)} needed, ${size(report.shm_free_bytes)} free`;
  return [
    makeText("h3", "", "Room"),
    makeText("p", "", `Disk ${disk.directory}: ${rate}, ${measured}${left}`),
    makeText("p", "", memory),
  ];
}
