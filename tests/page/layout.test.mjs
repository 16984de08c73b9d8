import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { MIN_TILE_PX, fitTile, imageRect, pixelAt, pointOver } = await load("layout.js");

const heightOf = (tile) => (tile * 9) / 16 + 26;

test("fourteen tiles of seven cameras are seen at once on a laptop", () => {
  const tile = fitTile([2, 2, 2, 2, 2, 2, 2], { width: 1424, height: 780 }, 8, heightOf);
  assert.ok(tile > 250, `${tile}`);
  assert.ok(4 * (heightOf(tile) + 8) - 8 <= 780);
});

test("one tile fills the wall in the direction that is short", () => {
  assert.equal(fitTile([1], { width: 1000, height: 2000 }, 8, heightOf), 1000);
  const tile = fitTile([1], { width: 3000, height: 476 }, 8, heightOf);
  assert.equal(tile, 800);
});

test("a wall that must scroll fills its rows", () => {
  const tile = fitTile([2, 2, 2, 2, 2, 2, 2], { width: 804, height: 300 }, 8, heightOf);
  assert.ok(tile >= MIN_TILE_PX);
  assert.equal(tile, 398);
});

test("a camera with more streams than a row has is wrapped", () => {
  assert.ok(fitTile([5], { width: 420, height: 2000 }, 8, heightOf) >= MIN_TILE_PX);
});

test("an image lies in the middle of its box, and points map to pixels and back", () => {
  const rect = imageRect({ width: 400, height: 400 }, 640, 360);
  assert.deepEqual(rect, { left: 0, top: 87.5, width: 400, height: 225 });
  assert.equal(pixelAt({ x: 10, y: 50 }, rect, 640, 360), null);
  assert.deepEqual(pixelAt({ x: 0, y: 87.5 }, rect, 640, 360), { x: 0, y: 0 });
  assert.equal(pixelAt({ x: 400, y: 100 }, rect, 640, 360), null);
  const pixel = { x: 123, y: 45 };
  assert.deepEqual(pixelAt(pointOver(pixel, rect, 640, 360), rect, 640, 360), pixel);
});
