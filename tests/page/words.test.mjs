import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { recordTexts } = await load("recordtext.js");
const { addScene, parseScenes } = await load("scenes.js");
const { age, clock, disk, hoverText, lossesInWords, missingInWords, size, sumOf } = await load("words.js");

test("losses are named by their reasons, the most frequent first", () => {
  assert.equal(lossesInWords("set", {}), "");
  assert.equal(lossesInWords("set", { disk_slow: 1 }), "1 set lost (the disk is too slow)");
  const text = lossesInWords("frame", { no_slot: 2, device_gap: 10, incomplete: 0 });
  assert.equal(text, "12 frames lost (10 did not reach this computer, 2 subscribers held all slots)");
  assert.equal(lossesInWords("frame", { new_reason: 2 }), "2 frames lost (new reason)");
});

test("frames that sets lack are named by their stream", () => {
  assert.equal(missingInWords({}), "");
  assert.deepEqual([missingInWords({ "a/color": 1 }), missingInWords({ "a/color": 5, "b/depth": 0 })], ["1 set lacks a/color", "5 sets lack a/color"]);
  assert.equal(missingInWords({ "a/color": 3, "b/depth": 4 }), "7 frames missing in sets (4 b/depth, 3 a/color)");
});

test("losses are summed by reason", () => {
  assert.deepEqual(sumOf([{ a: 1 }, { a: 2, b: 3 }]), { a: 3, b: 3 });
});

test("times and sizes are short", () => {
  assert.deepEqual([clock(0), clock(61.9), clock(3661)], ["00:00", "01:01", "1:01:01"]);
  assert.deepEqual([age(-2), age(42.4), age(2345), age(90_000)], ["0 ms", "42 ms", "2.3 s", "01:30"]);
  assert.deepEqual([size(1.5e6), size(42e6), size(1.5e9), size(423e9), size(2e12)], ["1.5 MB", "42 MB", "1.5 GB", "423 GB", "2.00 TB"]);
  assert.equal(disk(423e9, 9400), "156 min left, 423 GB free");
  assert.equal(disk(423e9, null), "423 GB free");
});

test("a pixel is a depth in millimetres, or a hole", () => {
  const asked = { id: 1, stream: "a/depth", x: 3, y: 4, seen: [] };
  assert.equal(hoverText({ ...asked, depth_m: null }, true), "a/depth  (3, 4)\nhole");
  assert.equal(hoverText({ ...asked, depth_m: null }, false), "a/depth  (3, 4)\nno depth here");
  const text = hoverText({ ...asked, depth_m: 1.234, xyz_m: [0.1, -0.2, 1.2] }, true);
  assert.equal(text, "a/depth  (3, 4)\n1234 mm\nx 0.100  y -0.200  z 1.200 m");
});

test("scenes are offered newest first, each once, and storage may hold anything", () => {
  assert.deepEqual(addScene(["a", "b"], "b"), ["b", "a"]);
  assert.deepEqual(addScene(["a"], ""), ["a"]);
  assert.deepEqual(parseScenes("not json"), []);
  assert.deepEqual(parseScenes('["a", 3, null]'), ["a"]);
  assert.deepEqual(parseScenes(null), []);
});

test("a recording is described by what there is", () => {
  const recording = {
    active: true, path: "/d/x", name: "x", dropped: {}, duration_s: 65, sets: 9, bytes: 2e9, backlog_bytes: 3e6,
    error: null, warning: "little room left", disk_free_bytes: 4e9, disk_seconds_left: 90,
  };
  const facts = { state: "recording", bytesPerSecond: 42e6, sets: { disk_slow: 2 }, missing: {}, frames: {}, hasNewLosses: false };
  assert.deepEqual(recordTexts(recording, facts), {
    progress: "01:05 · 9 sets · 2.0 GB · 42.0 MB/s · x",
    losses: "2 sets lost (the disk is too slow)",
    advice: "The disk takes less than the rig writes: record to a faster disk, or record fewer or smaller streams.",
    losing: "lost",
    disk: "Disk: 1 min left, 4.0 GB free",
    warning: "little room left",
  });
  const few = recordTexts(recording, { ...facts, sets: {}, frames: { device_gap: 3 } });
  assert.deepEqual([few.losing, few.losses], ["few", "3 frames lost (did not reach this computer)"]);
  const lacking = recordTexts(recording, { ...facts, sets: {}, missing: { "a/color": 2 } });
  assert.deepEqual([lacking.losing, lacking.losses], ["lost", "2 sets lack a/color"]);
  assert.deepEqual(recordTexts(recording, { ...facts, sets: {} }).losing, "none");
  assert.match(recordTexts(recording, { ...facts, state: "closing" }).progress, /3.0 MB wait for the disk/);
  assert.match(recordTexts({ ...recording, active: false }, { ...facts, state: "idle" }).progress, /^Last: /);
  assert.equal(recordTexts(null, facts).progress, "Nothing recorded yet");
});
