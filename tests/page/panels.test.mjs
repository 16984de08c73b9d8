import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { lossAdvice } = await load("advice.js");
const { ageText, coverageText, stateText } = await load("calibrationtext.js");
const { controlFacts, diffLines, differsFromFile, valueText, whyNotSet } = await load("controltext.js");
const { Countdown } = await load("countdown.js");
const { addressOf, datasetOf, socketAddress } = await load("dataset.js");
const { DoublePress, TWICE_MS } = await load("doublepress.js");
const { EventParser } = await load("eventstream.js");
const { actionOf } = await load("keys.js");
const { readiness } = await load("ready.js");
const { healthText, numbersOf, titleOf, when, whyNotWatched } = await load("recordingtext.js");
const { pairSkews, preferredStream, signedMs, skewState, streamOfEach, streamSkews, windowMs } = await load("skew.js");
const { heat, uncertaintyText } = await load("uncertaintytext.js");
const { bySeverity, linkState, linkText, notInRig, usbTree } = await load("usbtree.js");

const stream = (id, more = {}) => ({ id, nominal_hz: 30, last_frame_age_ms: 20, samples_hz: null, ...more });
const camera = (name, streams, more = {}) => ({ name, state: "streaming", message: null, streams, ...more });
const rig = (cameras, sets = {}, more = {}) => ({
  cameras, preparing: null, recording: null, replay: null, ...more,
  sets: { nominal_hz: 5, sent: 9, incomplete: 0, spread_p50_ms: 4, spread_p95_ms: 9, skews: [], ...sets },
});
const both = [camera("a", [stream("a/color"), stream("a/depth")]), camera("b", [stream("b/depth"), stream("b/infrared")])];

test("the same key twice in time is a double press, and only that", () => {
  const twice = new DoublePress();
  assert.equal(twice.press("r", 0), false);
  assert.equal(twice.press("r", TWICE_MS), true);
  assert.equal(twice.press("r", TWICE_MS + 1), false);
  assert.equal(twice.press("r", 2 * TWICE_MS + 2), false);
  assert.equal(twice.press("b", 2 * TWICE_MS + 3), false);
});

test("a countdown counts whole seconds, and a cancelled one starts nothing", (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const said = [];
  const countdown = new Countdown((left) => said.push(left), () => said.push("go"));
  countdown.start(3);
  context.mock.timers.tick(1000);
  context.mock.timers.tick(1000);
  assert.equal(countdown.left, 1);
  context.mock.timers.tick(1000);
  assert.deepEqual(said, [3, 2, 1, "go"]);
  assert.equal(countdown.cancel(), false);
  countdown.start(3);
  assert.equal(countdown.cancel(), true);
  context.mock.timers.tick(9000);
  assert.deepEqual(said, [3, 2, 1, "go", 3]);
});

test("letters open panels and judge takes, unless a menu has the focus", () => {
  const event = { key: "L", repeat: false, ctrlKey: false, altKey: false, metaKey: false };
  const nowhere = { isText: false, takesSpace: false, takesEnter: false, takesArrows: false, takesLetters: false, isInDialog: false };
  assert.deepEqual(actionOf(event, nowhere), { action: "panel", panel: "recordings" });
  assert.equal(actionOf(event, { ...nowhere, takesLetters: true }), null);
  assert.equal(actionOf({ ...event, key: "3" }, { ...nowhere, takesLetters: true }), null);
  assert.deepEqual(actionOf({ ...event, key: "b" }, nowhere), { action: "bad" });
  // A pedal that is held down must not be its own second press.
  assert.equal(actionOf({ ...event, key: "b", repeat: true }, nowhere), null);
});

test("the address of a dataset holds any name", () => {
  for (const name of ["2026-01-01_kitchen", "a b&c=d#e?f", "<img src=x>", "../etc"]) {
    const address = addressOf("/", name);
    assert.equal(datasetOf(new URL(address, "http://h").search), name);
    assert.equal(new URL(address, "http://h").pathname, "/");
  }
  assert.equal(datasetOf(""), null);
  assert.equal(datasetOf("?dataset="), null);
  assert.equal(addressOf("/", null), "/");
  assert.equal(socketAddress({ protocol: "http:", host: "localhost:1" }, null), "ws://localhost:1/v1/live");
  assert.equal(socketAddress({ protocol: "https:", host: "h" }, "a b"), "wss://h/v1/live?dataset=a%20b");
});

test("losses say what to do, sets before frames, the most frequent reason first", () => {
  assert.match(lossAdvice({ disk_slow: 1, encoder_busy: 3 }, {}, { device_gap: 99 }), /encodes too slowly/);
  assert.match(lossAdvice({}, { "a/color": 4 }, { device_gap: 9, no_slot: 1 }), /USB/);
  assert.equal(lossAdvice({ disk_slow: 0 }, {}, {}), "");
  assert.match(lossAdvice({}, { "a/color": 1, "b/color": 2 }, {}), /b\/color/);
  assert.match(lossAdvice({ weather: 1 }, {}, {}), /log/);
});

test("a rig is ready when every stream comes", () => {
  const ready = readiness(rig(both), null);
  assert.equal(ready.state, "go");
  assert.match(ready.text, /^Go: 4 streams, sets within 9.0 ms; doctor was not asked/);
});

test("a stream that does not come is a no-go, and is named", () => {
  const silent = [camera("a", [stream("a/color", { last_frame_age_ms: 4000 }), stream("a/depth")])];
  assert.equal(readiness(rig(silent), null).state, "no-go");
  assert.match(readiness(rig(silent), null).text, /a\/color: no images/);
  const never = [camera("a", [stream("a/color", { last_frame_age_ms: null })])];
  assert.equal(readiness(rig(never), null).state, "no-go");
  const failed = [...both, camera("c", [], { state: "failed" })];
  assert.match(readiness(rig(failed), null).text, /c \(failed\)/);
  const imu = [camera("a", [stream("a/color"), stream("a/imu", { samples_hz: 200, last_frame_age_ms: null })])];
  assert.equal(readiness(rig(imu), null).state, "go");
  const left = { host: "left", state: "connected", why: null, cameras: 3, streaming: 3, has_clock: true };
  const withLeft = (/** @type {object} */ more) => readiness({ ...rig(both), hosts: { hosts: [{ ...left, ...more }] } }, null).text;
  assert.match(withLeft({}), /^Go: .*with left/);
  assert.match(withLeft({ state: "absent", why: "ssh left: no route" }), /^No-go: left \(absent\): ssh left: no route/);
  assert.match(withLeft({ streaming: 2 }), /^No-go: left: 2 of 3 cameras/);
  assert.match(withLeft({ has_clock: false }), /^No-go: left: its clock is not known yet/);
  assert.match(readiness({ ...rig(both), link: { host: "a", recorder: "b", state: "silent" } }, null).text, /the clock of b does not answer/);
});

test("few minutes, a wide spread and doctor's findings are said", () => {
  const disk = (minutes_left) => ({ verdict: "good", findings: [], disk: { minutes_left } });
  assert.equal(readiness(rig(both), disk(4)).state, "no-go");
  assert.equal(readiness(rig(both), disk(20)).state, "check");
  assert.match(readiness(rig(both), disk(700)).text, /11 h on the disk, .*doctor found nothing/);
  assert.match(readiness(rig(both, { spread_p95_ms: 40 }), null).text, /^Check: sets within 40.0 ms, more than a frame/);
  const warned = { ...disk(99), findings: [{ severity: "warning" }, { severity: "info" }] };
  assert.match(readiness(rig(both), warned).text, /doctor has 1 warning \(D\)/);
  const error = { ...disk(99), findings: [{ severity: "error" }] };
  assert.equal(readiness(rig(both), error).state, "no-go");
});

test("skews are judged against the window that a frame must lie in", () => {
  assert.ok(Math.abs(windowMs(30) - 17.67) < 0.01);
  assert.equal(windowMs(0), Infinity);
  assert.deepEqual([0, -5, 9, -18].map((ms) => skewState(ms, 17)), ["good", "good", "wide", "out"]);
  assert.equal(skewState(null, 17), "none");
  const skews = [{ stream: "a/color", median_ms: -1.25, p95_ms: 3.4 }, { stream: "b/infrared", median_ms: 12, p95_ms: 14 }];
  const rows = streamSkews(rig(both, { skews }));
  assert.deepEqual(rows.map(({ state }) => state), ["good", "none", "none", "wide"]);
  const cameras = streamOfEach(rig(both));
  assert.deepEqual(cameras, ["a/color", "b/infrared"]);
  const [[, ab], [ba]] = pairSkews(rows, cameras);
  assert.deepEqual([ab.ms, ba.ms, ab.state], [13.25, -13.25, "wide"]);
  assert.deepEqual([-1.25, 3.44, -0.01, null].map(signedMs), ["-1.3", "+3.4", "0.0", "–"]);
});

test("a camera stands in the tables with its colour images, or with what it has", () => {
  assert.equal(preferredStream("a", ["a/depth", "a/color"]), "a/color");
  assert.equal(preferredStream("a", ["a/depth", "a/x"]), "a/depth");
  assert.equal(preferredStream("a", []), undefined);
});

const entry = {
  name: "x", path: "/d/x", scene: "", operator: "", rig: "r", started_utc_ns: 0, duration_ns: 65e9, sets: 1, sets_lost: 0,
  streams: ["a/color", "b/color"], segments: 1, bytes: 2e9, health: "whole", why: [], mark: null, has_report: true,
};

test("a recording is described as far as it is known", () => {
  assert.equal(numbersOf(entry), "01:05 · 1 set · 2 streams · 2.0 GB");
  assert.equal(numbersOf({ ...entry, sets_lost: 3, streams: 4 }), "01:05 · 1 set · 3 lost · 4 streams · 2.0 GB");
  assert.equal(numbersOf({ ...entry, duration_ns: null, sets: null, streams: null, bytes: null }), "");
  assert.equal(titleOf(entry), "no scene");
  assert.equal(when(0), "unknown time");
  assert.match(when(1.7e18), /^2023-11-1\d \d\d:13$/);
  assert.equal(healthText({ ...entry, health: "asleep" }), "asleep");
  assert.equal(whyNotWatched(entry), "");
  assert.notEqual(whyNotWatched({ ...entry, health: "recording" }), "");
});

const attached = (port, controller, more = {}) => ({
  backend: "v4l2", model: "cam", serial: "7", port, usb_mbps: 5000, controller, state: "free", rig: null, held_by: [], problems: [], ...more,
});
const plan = (name, port, mbit) => ({ name, backend: "v4l2", device: "", port, streams: [{ usb_mbit_s: mbit }, { usb_mbit_s: 1 }], worst: null });
const report = {
  cameras: [plan("left", "2-1.10", 40), plan("gone", null, 5)],
  attached: {
    cameras: [attached("2-1.10", "c1"), attached("2-1.2", "c1"), attached("r/x", null, { usb_mbps: null, held_by: [{ pid: 4, name: "obs" }], state: "in_use" })],
    unusable: [], not_asked: [],
  },
};

test("the USB tree goes from controller to port, in the order of the ports", () => {
  const [first, last] = usbTree(report);
  assert.deepEqual(first.ports.map(({ port }) => port), ["2-1.2", "2-1.10"]);
  assert.deepEqual([first.controller, last.controller], ["c1", "not on USB"]);
  assert.deepEqual([first.ports[1].camera, first.ports[1].loadMbitS, first.ports[1].speed], ["left", 41, "5 Gbit/s"]);
  assert.equal(last.ports[0].use, "in use by obs (process 4)");
  assert.deepEqual(notInRig(report).map(({ port }) => port), ["2-1.2", "r/x"]);
});

test("a link is judged by what it may and can carry", () => {
  const link = { link: "hub", cameras: ["a", "b"], speed_mbps: 480, load_mbit_s: 200, plan_mbit_s: 300, most_mbit_s: 426 };
  assert.deepEqual([200, 301, 427].map((load_mbit_s) => linkState({ ...link, load_mbit_s })), ["good", "warning", "error"]);
  assert.match(linkText(link), /hub \(480 Mbit\/s\): 200 of 300 .* 426; a, b/);
});

test("findings stand the worst first", () => {
  const groups = bySeverity([{ severity: "info" }, { severity: "error" }, { severity: "info" }]);
  assert.deepEqual(groups.map(({ severity, findings }) => [severity, findings.length]), [["error", 1], ["info", 2]]);
});

const control = {
  name: "exposure", kind: "integer", minimum: 1, maximum: 100, step: 5, default: 50, value: 20, in_file: null, is_active: true, is_read_only: false,
};

test("a control says its range, default and file value, and why it cannot be set", () => {
  assert.equal(controlFacts(control), "1 to 100 in steps of 5 · default 50 · not in the rig file");
  const menu = { ...control, kind: "menu", items: [{ value: 1, name: "Auto" }, { value: 3, name: "Manual" }], default: 3, value: 1, in_file: "Auto" };
  assert.equal(controlFacts(menu), "default Manual · rig file Auto");
  assert.equal(valueText({ ...control, kind: "boolean" }, false), "off");
  assert.equal(whyNotSet(control), "");
  assert.match(whyNotSet({ ...control, is_active: false }), /Inactive/);
  assert.match(whyNotSet({ ...control, is_read_only: true }), /only reports/);
  assert.deepEqual([null, 20, 21].map((in_file) => differsFromFile({ ...control, in_file })), [false, false, true]);
});

test("a difference is shown line by line", () => {
  const kinds = diffLines("--- a\n+++ b\n@@ -1 +1 @@\n same\n-old\n+new\n").map(({ kind }) => kind);
  assert.deepEqual(kinds, ["place", "place", "place", "same", "removed", "added"]);
});

test("server-sent events are read whatever pieces they come in", () => {
  const text = ": hello\n\ndata: {\"a\":1}\n\n\n\ndata: one\ndata: two\n\n";
  for (let size = 1; size <= text.length; size += 1) {
    const parser = new EventParser();
    const events = [];
    for (let at = 0; at < text.length; at += size) {
      events.push(...parser.push(text.slice(at, at + size)));
    }
    assert.deepEqual(events, ['{"a":1}', "one\ntwo"], `${size}`);
  }
});

test("a calibration and a capture are put in words", () => {
  assert.deepEqual([0.4, 1.2, 9.9].map((age_days) => ageText({ age_days })), ["calibrated today", "calibrated yesterday", "calibrated 9 days ago"]);
  assert.equal(ageText({ age_days: null, created: "in May" }), "calibrated in May");
  assert.equal(stateText("hold_still"), "Hold still");
  const seen = { views: 3, coverage: [0, 2, 0, 9], corners: 0, worst_px: null };
  assert.equal(coverageText(seen), "3 views · 2 of 4 parts of the image · does not see the board");
  assert.match(coverageText({ ...seen, worst_px: 0.456, corners: 24 }), /within 0.46 px · sees 24 corners/);
});

test("the uncertainty of a calibration has the colours of its report, and words", () => {
  assert.deepEqual([0, 0.5, 1, 7].map(heat), ["hsl(130 70% 60%)", "hsl(65 70% 60%)", "hsl(0 70% 60%)", "hsl(0 70% 60%)"]);
  const image = { stream: "a/color", created: "", width: 4, height: 3, uncertainty: null };
  assert.match(uncertaintyText(image), /^a\/color: the calibration's file has no map of uncertainty/);
  const uncertainty = { distance_m: 0.8, pixel_mm: 1.5, columns: 2, sigma_px: [0.1, null], middle_px: 0.1, worst_px: 0.42 };
  assert.match(uncertaintyText({ ...image, uncertainty }), /at 0\.80 m, .*0\.10 px \(0\.15 mm\) in the middle, at most 0\.42 px \(0\.63 mm\)/);
});
