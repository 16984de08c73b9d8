import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { actionOf } = await load("keys.js");
const { RecordingWatch, isOlder } = await load("recording.js");
const { periodMs, tileState } = await load("tilestate.js");
const { WatchList, watchOf } = await load("watch.js");

const camera = { name: "a", state: "streaming", message: null, reconnects: 0, streams: [] };
const facts = { camera, now: 10_000, drawnAt: 9_950, watchedSince: 0, periodMs: 100, isLive: true, isPaused: false, preparing: "" };

test("a tile is stale half a second after an image was due", () => {
  assert.equal(tileState(facts).state, "live");
  assert.equal(tileState({ ...facts, drawnAt: 9_400 }).state, "live");
  assert.deepEqual(tileState({ ...facts, drawnAt: 9_399 }), { state: "stale", message: "No new image for 601 ms" });
  assert.equal(tileState({ ...facts, drawnAt: 5_000, watchedSince: 9_900 }).state, "live");
  assert.equal(tileState({ ...facts, drawnAt: 5_000, isPaused: true }).state, "live");
  assert.equal(tileState({ ...facts, drawnAt: -Infinity }).state, "waiting");
});

test("a camera that fails shows the cure, a lost connection shows before everything", () => {
  const failed = { ...camera, state: "failed", message: "plug it in" };
  assert.deepEqual(tileState({ ...facts, camera: failed }), { state: "failed", message: "Failed: plug it in" });
  assert.equal(tileState({ ...facts, camera: { ...failed, state: "reconnecting" } }).state, "failed");
  assert.equal(tileState({ ...facts, camera: failed, isLive: false }).state, "stale");
});

test("the period is that of the slower of stream and request", () => {
  assert.equal(periodMs(10, 30), 100);
  assert.equal(periodMs(10, 5), 200);
  assert.equal(periodMs(10, 0), 100);
});

test("tiles off the screen are not watched; the enlarged one is watched in full", () => {
  const tiles = ["a/color", "a/depth", "b/color"].map((id, i) => ({ id, isOnScreen: i < 2 }));
  assert.deepEqual(watchOf(tiles, null, null).map(({ stream, width, rate_hz }) => [stream, width, rate_hz]), [["a/color", 640, 10], ["a/depth", 640, 10]]);
  const blend = { below: tiles[0], above: tiles[1] };
  assert.deepEqual(watchOf(tiles, tiles[0], blend).map(({ width }) => width), [0, 0]);
  assert.deepEqual(watchOf(tiles, tiles[2], null).map(({ width }) => width), [320, 320, 0]);
});

test("an image of an earlier watch list belongs to no stream", () => {
  let number = 0;
  const list = new WatchList(() => ++number);
  const a = { stream: "a/color", width: 640, rate_hz: 10 };
  const b = { stream: "b/color", width: 640, rate_hz: 10 };
  assert.deepEqual(list.ask([a]), ["a/color"]);
  assert.deepEqual(list.ask([a]), []);
  assert.equal(number, 1);
  assert.deepEqual(list.ask([b, a]), ["b/color"]);
  assert.equal(list.streamOf({ watch: 1, index: 0 }), null);
  assert.equal(list.streamOf({ watch: 2, index: 1 }), "a/color");
  assert.equal(list.streamOf({ watch: 2, index: 2 }), null);
  list.forget();
  assert.deepEqual(list.ask([b, a]), ["b/color", "a/color"]);
});

const key = (name, more = {}) => ({ key: name, repeat: false, ctrlKey: false, altKey: false, metaKey: false, ...more });
const nowhere = { isText: false, takesSpace: false, takesEnter: false, takesArrows: false, takesLetters: false, isInDialog: false };

test("keys do nothing in text fields and dialogs, nor with modifiers", () => {
  for (const name of [" ", "n", "1", "?", "Escape", "ArrowLeft", "p", "r", "b", "G", "m", "l", "y", "d", "c", "k", "a", "o", "v"]) {
    assert.notEqual(actionOf(key(name), nowhere), null, name);
    assert.equal(actionOf(key(name), { ...nowhere, isText: true }), null, name);
    assert.equal(actionOf(key(name), { ...nowhere, isInDialog: true }), null, name);
    assert.equal(actionOf(key(name, { ctrlKey: true }), nowhere), null, name);
  }
});

test("a key that is held starts and stops once; arrows may repeat", () => {
  assert.equal(actionOf(key(" ", { repeat: true }), nowhere), null);
  assert.deepEqual(actionOf(key("ArrowLeft", { repeat: true }), nowhere), { action: "step", sets: -1 });
  assert.equal(actionOf(key("ArrowLeft"), { ...nowhere, takesArrows: true }), null);
  assert.equal(actionOf(key(" "), { ...nowhere, takesSpace: true }), null);
  assert.deepEqual(actionOf(key("9"), nowhere), { action: "camera", n: 9 });
  assert.equal(actionOf(key("0"), nowhere), null);
});

const recording = (more) => ({ active: true, path: "/d", dropped: {}, missing: {}, frames_dropped: {}, bytes: 0, duration_s: 0, ...more });
const status = (seconds, taken) => ({ utc_ns: seconds * 1e9, cameras: [], recording: taken });

test("a recording that is being closed says so, for whoever asked", () => {
  const watch = new RecordingWatch();
  assert.equal(watch.follow(status(0, null), false).state, "idle");
  assert.equal(watch.follow(status(1, recording({ duration_s: 0.6 })), false).state, "recording");
  // A set that is slow to come is no sign of closing.
  assert.equal(watch.follow(status(1.5, recording({ duration_s: 0.6 })), false).state, "recording");
  assert.equal(watch.follow(status(1.6, recording({ duration_s: 0.7 })), true).state, "closing");
  assert.equal(watch.follow(status(2, recording({ duration_s: 0.7, closing: true })), false).state, "closing");
  assert.equal(watch.follow(status(2.5, recording({ duration_s: 0.7, active: false })), false).state, "idle");
});

test("losses count from the start of the recording, and are new once", () => {
  const watch = new RecordingWatch();
  const lost = (n, more = {}) => recording({ frames_dropped: { no_slot: n }, ...more });
  // A page that is opened late shows them all, and none as news.
  assert.deepEqual([watch.follow(status(0, lost(7)), false)].map((f) => [f.frames, f.hasNewLosses]), [[{ no_slot: 7 }, false]]);
  assert.equal(watch.follow(status(1, lost(9)), false).hasNewLosses, true);
  assert.equal(watch.follow(status(2, lost(9)), false).hasNewLosses, false);
  assert.equal(watch.follow(status(3, lost(9, { missing: { "a/color": 1 } })), false).hasNewLosses, true);
  const ended = watch.follow(status(4, lost(9, { active: false })), false);
  assert.deepEqual([ended.frames, ended.hasNewLosses], [{ no_slot: 9 }, false]);
});

test("the rate is that of the last seconds", () => {
  const watch = new RecordingWatch();
  watch.follow(status(0, recording({ duration_s: 0 })), false);
  assert.equal(watch.follow(status(0.5, recording({ duration_s: 0.5, bytes: 5e6 })), false).bytesPerSecond, null);
  assert.equal(watch.follow(status(2, recording({ duration_s: 2, bytes: 40e6 })), false).bytesPerSecond, 20e6);
});

test("a status that waited behind images does not undo a start or a stop", () => {
  const started = recording({ path: "/b", started_utc_ns: 5e9 });
  assert.equal(isOlder(started, status(4.9, null)), true);
  assert.equal(isOlder(started, status(4.9, recording({ path: "/a", active: false }))), true);
  assert.equal(isOlder(started, status(5.1, started)), false);
  const stopped = recording({ path: "/b", active: false });
  assert.equal(isOlder(stopped, status(9, recording({ path: "/b" }))), true);
  assert.equal(isOlder(stopped, status(9, recording({ path: "/c" }))), false);
  assert.equal(isOlder(stopped, status(9, stopped)), false);
});
