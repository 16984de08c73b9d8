/** The USB tree of doctor's report, and its words: pure functions. */

/** @typedef {import("./paneltypes.js").DoctorReport} DoctorReport */
/** @typedef {import("./paneltypes.js").AttachedCamera} AttachedCamera */
/** @typedef {import("./paneltypes.js").LinkLoad} LinkLoad */
/** @typedef {import("./paneltypes.js").Finding} Finding */
/** @typedef {import("./paneltypes.js").Severity} Severity */

/**
 * @typedef {Object} PortNode
 * @property {string} port
 * @property {string} device in words
 * @property {string} speed
 * @property {string | null} camera of the rig
 * @property {string} use
 * @property {number} loadMbitS
 * @property {string[]} problems
 *
 * @typedef {{controller: string, ports: PortNode[]}} ControllerNode
 */

const NOT_USB = "not on USB";
/** @type {Severity[]} */
const WORST_FIRST = ["error", "warning", "info", "good"];

/** @param {number | null} mbps */
export function speedText(mbps) {
  if (mbps === null || mbps === undefined) {
    return "";
  }
  return mbps >= 1000 ? `${mbps / 1000} Gbit/s` : `${mbps} Mbit/s`;
}

/** @param {AttachedCamera} camera */
function useText(camera) {
  if (camera.rig) {
    return `in use by rig ${camera.rig}`;
  }
  const holders = camera.held_by.map(({ pid, name }) => `${name} (process ${pid})`);
  return holders.length > 0 ? `in use by ${holders.join(", ")}` : camera.state.replaceAll("_", " ");
}

/** @param {AttachedCamera} camera */
function deviceText(camera) {
  return [camera.model, camera.serial ?? ""].filter(Boolean).join(" ");
}

/**
 * Attached cameras by controller and port, with the load that the rig plans on each.
 *
 * @param {DoctorReport} report
 * @returns {ControllerNode[]}
 */
export function usbTree(report) {
  /** @type {Map<string, PortNode[]>} */
  const controllers = new Map();
  for (const camera of report.attached.cameras) {
    const plan = report.cameras.find(({ port }) => port !== null && port === camera.port);
    const ports = controllers.get(camera.controller ?? NOT_USB) ?? [];
    controllers.set(camera.controller ?? NOT_USB, ports);
    ports.push({
      port: camera.port,
      device: deviceText(camera),
      speed: speedText(camera.usb_mbps),
      camera: plan?.name ?? null,
      use: useText(camera),
      loadMbitS: plan?.streams.reduce((sum, stream) => sum + stream.usb_mbit_s, 0) ?? 0,
      problems: camera.problems,
    });
  }
  const byPort = (/** @type {PortNode} */ a, /** @type {PortNode} */ b) => a.port.localeCompare(b.port, "en", { numeric: true });
  return [...controllers]
    .sort(([a], [b]) => Number(a === NOT_USB) - Number(b === NOT_USB) || a.localeCompare(b))
    .map(([controller, ports]) => ({ controller, ports: ports.sort(byPort) }));
}

/**
 * Cameras that are attached and that the rig has no use for.
 *
 * @param {DoctorReport} report
 */
export function notInRig(report) {
  const planned = report.cameras.map(({ port }) => port);
  return report.attached.cameras.filter((camera) => !planned.includes(camera.port) && !camera.rig);
}

/** @param {LinkLoad} link */
export function linkText(link) {
  const load = `${link.load_mbit_s.toFixed(0)} of ${link.plan_mbit_s.toFixed(0)} Mbit/s planned for`;
  return `${link.link} (${speedText(link.speed_mbps)}): ${load}, it carries ${link.most_mbit_s.toFixed(0)}; ${link.cameras.join(", ")}`;
}

/** @param {LinkLoad} link */
export function linkState(link) {
  return link.load_mbit_s > link.most_mbit_s ? "error" : link.load_mbit_s > link.plan_mbit_s ? "warning" : "good";
}

/**
 * @param {Finding[]} findings
 * @returns {{severity: Severity, findings: Finding[]}[]} the worst first
 */
export function bySeverity(findings) {
  return WORST_FIRST.map((severity) => ({
    severity,
    findings: findings.filter((finding) => finding.severity === severity),
  })).filter((group) => group.findings.length > 0);
}
