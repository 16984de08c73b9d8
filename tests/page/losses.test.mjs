import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { barsOf, causeOf, causesOf, lengthOf, momentAt, momentText, momentsOf, summaryText } = await load("losstime.js");

const bucket = (fromS, more) => ({ from_s: fromS, sets: {}, missing: {}, frames: {}, ...more });
const losses = (bucketS, ...buckets) => ({ path: "/d", duration_s: 100, bucket_s: bucketS, buckets });
const near = (actual, expected) => assert.ok(Math.abs(actual - expected) < 1e-9, `${actual} is not ${expected}`);

test("a bar lies where its time is, as wide as its bucket", () => {
  const [bar] = barsOf(losses(2, bucket(20, { sets: { disk_slow: 10 } })), 100, 5);
  near(bar.left, 0.2);
  near(bar.width, 0.02);
  near(bar.height, 1);
  assert.equal(bar.cause, "disk");
});

test("few lost frames never look like lost sets, nor do sets that lack one", () => {
  const height = (more) => barsOf(losses(1, bucket(3, more)), 100, 5)[0].height;
  const most = 1e9;
  assert.ok(height({ frames: { device_gap: 1 } }) < height({ frames: { device_gap: most } }));
  assert.ok(height({ frames: { device_gap: most } }) <= 0.25);
  assert.ok(height({ frames: { device_gap: most } }) < height({ missing: { "a/color": 1 } }));
  assert.ok(height({ missing: { "a/color": most } }) < height({ sets: { disk_slow: 1 } }));
  assert.ok(height({ sets: { disk_slow: 1 } }) < height({ sets: { disk_slow: 5 } }));
});

test("the tallest bar of a bucket lies below the others", () => {
  const bars = barsOf(losses(1, bucket(0, { frames: { no_slot: 3 }, sets: { encoder_busy: 1 }, missing: { "a/color": 2 } })), 10, 5);
  assert.deepEqual(bars.map(({ cause }) => cause), ["computer", "camera", "computer"]);
  assert.ok(bars[0].height > bars[1].height && bars[1].height > bars[2].height);
  assert.deepEqual(causesOf(bars), ["computer", "camera"]);
  assert.deepEqual(barsOf(losses(1), 10, 5), []);
});

test("every reason has a cause, one that a later daemon knows as well", () => {
  assert.deepEqual(["disk_slow", "queue_full", "device_gap", "ended", "weather"].map(causeOf), ["disk", "computer", "camera", "end", "camera"]);
});

test("losses after the last set lie inside the strip", () => {
  const late = losses(4, bucket(100, { sets: { ended: 2 } }));
  assert.equal(lengthOf(late, 98), 104);
  assert.equal(lengthOf(losses(1), 0), 1);
  const [bar] = barsOf(late, 98, 5);
  near(bar.left + bar.width, 1);
});

test("neighbouring buckets are one moment, others are not", () => {
  const moments = momentsOf(
    losses(
      1,
      bucket(10, { sets: { disk_slow: 5 } }),
      bucket(11, { sets: { disk_slow: 4 }, frames: { no_slot: 1 } }),
      bucket(12, { sets: { write_failed: 1 } }),
      bucket(20, { missing: { "a/color": 3 } }),
    ),
  );
  assert.deepEqual(moments.map(({ fromS, toS }) => [fromS, toS]), [[10, 13], [20, 21]]);
  assert.equal(momentText(moments[0]), "00:10 to 00:13: 10 sets lost (9 the disk is too slow, 1 writing failed); 1 frame lost (subscribers held all slots)");
  assert.equal(momentText(moments[1]), "00:20 to 00:21: 3 sets lack a/color");
  assert.equal(summaryText(moments, 61), "Losses at 2 moments of 01:01");
  assert.equal(summaryText(moments.slice(1), 61), "Losses at 1 moment of 01:01; no set was lost");
});

test("a pointer means the moment below it, or the nearest one within reach", () => {
  const moments = momentsOf(losses(1, bucket(10, { sets: { ended: 1 } }), bucket(20, { sets: { ended: 1 } })));
  assert.deepEqual([10.5, 9.2, 12.1, 19.5, 0].map((at) => momentAt(moments, at, 1)), [0, 0, -1, 1, -1]);
  assert.equal(momentAt([], 3, 1), -1);
});
