import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { countsText, episodeState, episodeText, isAsAnswered, lengthText } = await load("episodetext.js");
const { actionOf } = await load("keys.js");
const { parseText, signalsMessage } = await load("protocol.js");
const { readiness } = await load("ready.js");
const { PLOT_MS, Trace, faultText, lookOf, namesOf, numbersText, restOf, valuesOf } = await load("signals.js");

const status = (more = {}) => ({ signal: "arm/q", required: false, state: "live", age_s: 0.02, samples: 40, missed: 0, ...more });
const news = (more = {}) => ({
  signal: "arm/q", problem: null, fields: [], values: [], age_s: 0.02, rate_hz: 50, restarts: 0, points: [], ...more,
});
const point = (number, ms, ...values) => ({ number, ms, gap: false, values });

test("the signals of the rig file stand first, then those that are published", () => {
  assert.deepEqual(namesOf([status(), status({ signal: "b/x" })], ["a/y", "b/x"]), ["arm/q", "b/x", "a/y"]);
});

test("a required signal that does not come is a fault with its cure, another one is not", () => {
  assert.equal(lookOf(status(), news()), "live");
  assert.equal(lookOf(status({ required: true, state: "silent", age_s: 3 }), news()), "failed");
  assert.equal(lookOf(status({ state: "silent", age_s: 3 }), news()), "silent");
  assert.equal(lookOf(undefined, news({ age_s: null })), "waiting");
  assert.equal(lookOf(status(), news({ problem: "no place" })), "failed");
  assert.equal(faultText(status(), news()), "");
  assert.match(faultText(status({ required: true, state: "silent", age_s: 3.24 }), news()), /^Silent for 3.2 s.*no recording begins/);
  assert.match(faultText(status({ state: "missing", age_s: null }), undefined), /Start the program that does\.$/);
  assert.equal(faultText(status(), news({ problem: "no place" })), "no place");
});

test("the numbers of a signal are said, its losses too", () => {
  const fields = [{ name: "a", type: "f64", unit: "rad" }, { name: "b", type: "f64", unit: "rad" }];
  assert.equal(numbersText(status(), news({ fields })), "50.0 Hz · 20 ms · rad · 40 samples · 0 lost");
  const worse = numbersText(status({ missed: 3, required: true }), news({ restarts: 2, rate_hz: null }));
  assert.equal(worse, "20 ms · 40 samples · 3 lost · published anew 2× · required");
  assert.equal(numbersText(undefined, undefined), "");
});

test("values stand by the names of their fields, and numbers have lines", () => {
  const fields = [
    { name: "q", type: "f64", count: 2, unit: "rad" }, { name: "n", type: "i64" }, { name: "closed", type: "bool" },
    { name: "phase", type: "text" }, { name: "late", type: "f32" },
  ];
  const values = valuesOf(fields, [[1, null], [70000000], [false], ["<b>"], [1e-5]]);
  assert.deepEqual(values.map(({ label, text, line }) => [label, text, line]), [
    ["q[0]", "1.0000", 0], ["q[1]", "not a number", 1], ["n", "70000000", 2], ["closed", "no", -1], ["phase", "<b>", -1], ["late", "1.000e-5", 3],
  ]);
  assert.equal(restOf(fields, [[1], [], [], [], []]), 5);
});

test("a trace keeps the last seconds, breaks at gaps, and begins anew when time goes back", () => {
  const trace = new Trace();
  trace.add([point(1, 0, 0), point(2, 1000, 4), { ...point(3, 5000, 2), gap: true }, point(4, 6000, null), point(5, 7000, 1)]);
  const [pieces] = trace.lines({ low: 0, high: 4 });
  assert.deepEqual(pieces.map((piece) => piece.map(({ y }) => y)), [[1, 0], [0.5], [0.75]]);
  assert.equal(pieces.at(-1).at(-1).x, 1);
  assert.equal(trace.number, 5);
  trace.add([point(6, PLOT_MS + 500, 3)]);
  assert.deepEqual(trace.points.map(({ number }) => number), [2, 3, 4, 5, 6]);
  trace.add([point(7, 100, 9)]);
  assert.deepEqual(trace.points.map(({ number }) => number), [7]);
  trace.add([point(8, 200, 9, 9)]);
  assert.equal(trace.points.length, 1);
  for (let i = 0; i < 5000; i += 1) {
    trace.add([point(9 + i, 300 + i, i, 0)]);
  }
  assert.ok(trace.points.length <= 400);
  assert.equal(trace.points.at(-1).ms, 5299);
});

test("a plot has room for a value that does not change, and none for nothing", () => {
  const trace = new Trace();
  assert.equal(trace.span, null);
  trace.add([point(1, 0, null)]);
  assert.equal(trace.span, null);
  trace.add([point(2, 10, 7)]);
  assert.ok(trace.span.low < 7 && trace.span.high > 7);
});

test("the messages of signals are those of the daemon", () => {
  assert.equal(signalsMessage(null), '{"signals":null}');
  assert.equal(signalsMessage([{ signal: "arm/q", after: 7 }]), '{"signals":[{"signal":"arm/q","after":7}]}');
  assert.deepEqual(parseText('{"signals": {"published": [], "signals": []}}'), { signals: { published: [], signals: [] } });
});

test("a rig whose required signal is silent is a no-go", () => {
  const rig = (signals) => ({
    signals, cameras: [], preparing: null, recording: null, replay: null,
    sets: { nominal_hz: 5, sent: 0, incomplete: 0, spread_p50_ms: 0, skews: [] },
  });
  assert.match(readiness(rig([status({ required: true, state: "silent" })]), null).text, /^No-go: arm\/q \(silent\): no samples/);
  assert.equal(readiness(rig([status({ state: "silent" })]), null).state, "go");
});

const episode = (more = {}) => ({ number: 3, task: "cup", start_utc_ns: 1e18, end_utc_ns: 1e18 + 12e9, ...more });

test("an episode is said with its state, its length and its task", () => {
  assert.equal(episodeText(null, null), "No episode yet");
  const running = episode({ end_utc_ns: undefined });
  assert.equal(episodeText(running, 1e18 + 65e9), "Episode 3 runs · 01:05 · cup");
  assert.equal(episodeText(running, null), "Episode 3 runs · cup");
  assert.equal(episodeText(episode({ outcome: "success", task: "" }), null), "Last episode 3: success · 00:12");
  assert.equal(lengthText(episode(), 9e18), "00:12");
  const states = [episode(), episode({ outcome: "failure" }), episode({ outcome: "success", discarded: true }), running];
  assert.deepEqual(states.map(episodeState), ["kept", "failure", "discarded", "running"]);
  assert.equal(countsText({ episodes: 4, episodes_discarded: 1 }), "4 kept, 1 discarded");
  assert.equal(countsText({}), "0 kept");
});

test("a status that is older than the answer is known by its episode", () => {
  const running = episode({ end_utc_ns: undefined });
  assert.equal(isAsAnswered(running, null), false);
  assert.equal(isAsAnswered(running, episode({ number: 2 })), false);
  assert.equal(isAsAnswered(running, running), true);
  assert.equal(isAsAnswered(episode({ outcome: "success" }), running), false);
  assert.equal(isAsAnswered(episode({ outcome: "success" }), episode({ number: 4, end_utc_ns: undefined })), true);
});

test("episodes have keys that do not repeat", () => {
  const nowhere = { isText: false, takesSpace: false, takesEnter: false, takesArrows: false, takesLetters: false, isInDialog: false };
  const event = { key: "e", repeat: false, ctrlKey: false, altKey: false, metaKey: false };
  const actions = ["e", "s", "f", "x", "t"].map((key) => actionOf({ ...event, key }, nowhere).action);
  assert.deepEqual(actions, ["episode", "success", "failure", "discard", "task"]);
  assert.equal(actionOf({ ...event, repeat: true }, nowhere), null);
  assert.deepEqual(actionOf({ ...event, key: "i" }, nowhere), { action: "panel", panel: "signals" });
  assert.deepEqual(actionOf({ ...event, key: "j" }, nowhere), { action: "panel", panel: "episodes" });
});
