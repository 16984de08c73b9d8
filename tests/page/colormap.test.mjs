import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { MIN_SPAN_M, NEAREST_M, colorize, depthTable, rangeOf, sampleDepth, turbo, validRange } = await load("colormap.js");

const channels = (rgba) => [rgba & 255, (rgba >> 8) & 255, (rgba >> 16) & 255, rgba >>> 24];

test("turbo agrees with tools/src/turbo.rs at its ends and in the middle", () => {
  assert.deepEqual(turbo(0), [35, 23, 27]);
  assert.deepEqual(turbo(-3), turbo(0));
  assert.deepEqual(turbo(7), turbo(1));
  const [red, green, blue] = turbo(0.5);
  assert.ok(green > red && green > blue);
});

test("near is red, far is blue, a hole is transparent", () => {
  const table = depthTable(0.001, { near: 0.5, far: 4 });
  assert.equal(table[0], 0);
  const [nearRed, , nearBlue, nearAlpha] = channels(table[500]);
  const [farRed, , farBlue, farAlpha] = channels(table[4000]);
  assert.ok(nearRed > nearBlue + 50);
  assert.ok(farBlue > farRed + 50);
  assert.deepEqual([nearAlpha, farAlpha], [255, 255]);
});

test("depth beyond the range has the colour of its end", () => {
  const table = depthTable(0.001, { near: 0.5, far: 4 });
  assert.equal(table[1], table[500]);
  assert.equal(table[65535], table[4000]);
});

test("the unit of depth is taken into account", () => {
  const range = { near: 0.5, far: 4 };
  assert.equal(depthTable(0.0001, range)[20000], depthTable(0.001, range)[2000]);
});

test("colorize looks up every value", () => {
  const table = new Uint32Array(65536);
  table[9] = 0xff010203;
  const rgba = new Uint32Array(3);
  colorize(new Uint16Array([9, 0, 9]), table, rgba);
  assert.deepEqual([...rgba], [0xff010203, 0, 0xff010203]);
});

test("a range is never empty, wherever the sliders are", () => {
  for (const moved of ["near", "far"]) {
    for (const near of [-1, 0, 0.05, 3, 9.99, 10, 50, NaN]) {
      for (const far of [-1, 0, 0.05, 3, 9.99, 10, 50, NaN]) {
        const range = validRange(near, far, moved, 10);
        assert.ok(range.far - range.near >= MIN_SPAN_M - 1e-9, `${near} ${far} ${moved}`);
        assert.ok(range.near >= NEAREST_M - 1e-9 && range.far <= 10 + 1e-9, `${near} ${far} ${moved}`);
      }
    }
  }
});

test("a valid range is left alone, and the other end gives way", () => {
  assert.deepEqual(validRange(1, 2, "near", 10), { near: 1, far: 2, isCorrected: false });
  assert.deepEqual(validRange(3, 2, "near", 10), { near: 3, far: 3.05, isCorrected: true });
  assert.deepEqual(validRange(3, 2, "far", 10), { near: 1.95, far: 2, isCorrected: true });
});

test("the automatic range leaves out holes and outliers", () => {
  const depth = new Uint16Array(10001).fill(1000);
  depth.fill(3000, 5000);
  depth.fill(0, 0, 1000);
  depth[2000] = 65535;
  const metres = [];
  sampleDepth(depth, 0.001, 20000, metres);
  assert.equal(metres.length, 9001);
  const range = rangeOf(metres);
  assert.ok(Math.abs(range.near - 1) < 1e-9 && Math.abs(range.far - 3) < 1e-9);
});

test("without depth there is no automatic range; of a wall it has a span", () => {
  assert.equal(rangeOf([]), null);
  const range = rangeOf([2, 2, 2]);
  assert.ok(range.far - range.near >= MIN_SPAN_M - 1e-9);
});
