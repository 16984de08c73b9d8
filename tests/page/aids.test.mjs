import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { PEAKING_FROM, PeakHold, barHeights, lumaOf, markClipped, markPeaks } = await load("imagestats.js");
const { DepthSum, FRAMES, filledState, medianOf, noiseEndMm, paintHoles, paintNoise } = await load("depthstats.js");
const { fitPlane, insideImage, middleRect, pointsIn } = await load("plane.js");
const { watchOf } = await load("watch.js");

/** The same numbers in every run. */
function random(seed) {
  let state = seed;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 32;
  };
}

function gaussian(next) {
  return Math.sqrt(-2 * Math.log(1 - next())) * Math.cos(2 * Math.PI * next());
}

const near = (actual, expected, tolerance, what = "") =>
  assert.ok(Math.abs(actual - expected) <= tolerance, `${what} ${actual} is not ${expected}`);

test("luma is that of Rec. 601, to half a level", () => {
  const rgba = new Uint8ClampedArray([255, 255, 255, 255, 0, 0, 0, 255, 200, 40, 90, 255]);
  const luma = lumaOf(rgba);
  assert.deepEqual([luma[0], luma[1]], [255, 0]);
  near(luma[2], 0.299 * 200 + 0.587 * 40 + 0.114 * 90, 1);
});

test("peaking marks what a slow Laplacian finds, and never the border", () => {
  const columns = 23;
  const rows = 17;
  const next = random(3);
  const luma = Uint8Array.from({ length: columns * rows }, () => next() * 70 + 90);
  const overlay = new Uint32Array(luma.length);
  const count = markPeaks(luma, columns, overlay);
  let expected = 0;
  for (let y = 0; y < rows; y++) {
    for (let x = 0; x < columns; x++) {
      const at = (dx, dy) => luma[(y + dy) * columns + x + dx];
      const isInner = x > 0 && y > 0 && x < columns - 1 && y < rows - 1;
      const is = isInner && Math.abs(4 * at(0, 0) - at(-1, 0) - at(1, 0) - at(0, -1) - at(0, 1)) > PEAKING_FROM;
      assert.equal(overlay[y * columns + x] !== 0, is, `${x} ${y}`);
      expected += Number(is);
    }
  }
  assert.equal(count, expected);
  assert.ok(expected > 20 && expected < luma.length);
});

test("an even image has no edges and a soft ramp is not in focus", () => {
  const ramp = Uint8Array.from({ length: 100 * 10 }, (_, i) => (i % 100) * 2);
  assert.equal(markPeaks(ramp, 100, new Uint32Array(1000)), 0);
});

test("clipped pixels are counted, half of them are striped, others are left alone", () => {
  const columns = 40;
  const overlay = new Uint32Array(columns * 30);
  const rgba = new Uint8ClampedArray(overlay.length * 4).fill(128);
  for (let i = 0; i < overlay.length; i++) {
    if (i % columns < 10) rgba.set([252, 100, 100, 255], 4 * i);
    if (i % columns >= 30) rgba.set([0, 2, 1, 255], 4 * i);
  }
  assert.deepEqual(markClipped(rgba, columns, overlay), { bright: 300, dark: 300 });
  const marked = (from, to) => overlay.filter((value, i) => value !== 0 && i % columns >= from && i % columns < to).length;
  near(marked(0, 10), 150, 30);
  near(marked(30, 40), 150, 30);
  assert.equal(marked(10, 30), 0);
});

test("the peak is held until it is reset", () => {
  const hold = new PeakHold();
  assert.equal(hold.follow(0), 0);
  assert.deepEqual([5, 20, 10].map((value) => hold.follow(value)), [1, 1, 0.5]);
  assert.equal(hold.peak, 20);
  hold.reset();
  assert.equal(hold.follow(3), 1);
});

test("the highest bar is full, and small shares are seen beside it", () => {
  const heights = barHeights([0, 0.01, 0.99]);
  assert.deepEqual([heights[0], heights[2]], [0, 1]);
  assert.ok(heights[1] > 0.08);
  assert.deepEqual(barHeights([0, 0]), [0, 0]);
});

test("noise and holes of each pixel are those of a slow model", () => {
  const pixels = 200;
  const next = random(11);
  const images = Array.from({ length: FRAMES }, () =>
    Uint16Array.from({ length: pixels }, (_, i) => (next() < i / pixels ? 0 : 4000 + i * 20 + gaussian(next) * 3)));
  const sum = new DepthSum(pixels);
  images.forEach((image) => sum.add(image));
  assert.ok(sum.isComplete);
  const { deviationMm, holes, medianMm } = sum.summary(0.0005);
  const deviations = [];
  for (let i = 0; i < pixels; i++) {
    const values = images.map((image) => image[i]).filter((value) => value !== 0);
    near(holes[i], 1 - values.length / FRAMES, 1e-6, "holes");
    if (values.length < FRAMES / 2) {
      assert.ok(Number.isNaN(deviationMm[i]));
      continue;
    }
    const mean = values.reduce((a, b) => a + b) / values.length;
    const variance = values.reduce((a, b) => a + (b - mean) ** 2, 0) / (values.length - 1);
    near(deviationMm[i], Math.sqrt(variance) * 0.5, 1e-3, "deviation");
    deviations.push(deviationMm[i]);
  }
  deviations.sort((a, b) => a - b);
  assert.equal(medianMm, deviations[Math.floor((deviations.length - 1) / 2)]);
  near(medianMm, 1.5, 0.2);
});

test("the same image again and again has no noise, also far away", () => {
  const sum = new DepthSum(3);
  for (let i = 0; i < FRAMES; i++) {
    sum.add(new Uint16Array([0, 65535, 612]));
  }
  const { deviationMm, holes, medianMm } = sum.summary(0.001);
  assert.deepEqual([...holes], [1, 0, 0]);
  assert.ok(Number.isNaN(deviationMm[0]));
  assert.deepEqual([deviationMm[1], deviationMm[2], medianMm], [0, 0, 0]);
});

test("the median of many values is that of an even choice; of none it is null", () => {
  const next = random(5);
  near(medianOf(Float32Array.from({ length: 900_000 }, next)), 0.5, 0.02);
  assert.equal(medianOf(new Float32Array([NaN, NaN])), null);
  assert.equal(medianOf(new Float32Array([NaN, 3, 1, 2])), 2);
});

test("maps are transparent where nothing is known and red where it is worst", () => {
  const overlay = new Uint32Array(3);
  paintNoise(new Float32Array([NaN, 0, 100]), noiseEndMm({ medianMm: 2 }), overlay);
  const channels = (rgba) => [rgba & 255, (rgba >> 8) & 255, (rgba >> 16) & 255];
  assert.equal(overlay[0], 0);
  assert.ok(channels(overlay[1])[2] > channels(overlay[1])[0]);
  assert.ok(channels(overlay[2])[0] > 2 * channels(overlay[2])[2]);
  paintHoles(new Float32Array([0, 0.2, 1]), overlay);
  assert.equal(overlay[0], 0);
  assert.ok(channels(overlay[2])[0] > channels(overlay[1])[0]);
  assert.equal(noiseEndMm({ medianMm: null }), 1);
});

test("depth is good from 90 % filled and fair from 50 %", () => {
  assert.deepEqual([0, 0.1, 0.11, 0.5, 0.51, 1].map(filledState), ["good", "good", "fair", "fair", "bad", "bad"]);
});

const PINHOLE = { fx: 300, fy: 310, cx: 159.5, cy: 119.5 };
const unproject = (u, v) => [(u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy];
const IMAGE = { columns: 320, rows: 240, step: 1, unitM: 0.0001 };

/** Depth of the plane n·p = d, as a camera sees it. */
function planeImage([nx, ny, nz], d, noise = () => 0) {
  return Uint16Array.from({ length: 320 * 240 }, (_, i) => {
    const [x, y] = unproject(i % 320, Math.floor(i / 320));
    return Math.round((d / (nx * x + ny * y + nz) + noise()) / IMAGE.unitM);
  });
}

test("the tilt and the distance of a plane are found, whichever way it leans", () => {
  for (const tilt of [0, 5, 30, 60]) {
    for (const about of [0, 40, 200]) {
      const [t, a] = [tilt, about].map((degrees) => (degrees * Math.PI) / 180);
      const normal = [Math.sin(t) * Math.cos(a), Math.sin(t) * Math.sin(a), Math.cos(t)];
      const image = planeImage(normal, 1.2 * normal[2]);
      const plane = fitPlane(pointsIn(image, IMAGE, middleRect(320, 240), unproject, 5000));
      near(plane.tiltDeg, tilt, 0.1, `tilt about ${about}`);
      near(plane.distanceM, 1.2, 1e-3, "distance");
      assert.ok(plane.rmsM < 6e-5, `${plane.rmsM}: no more than rounding`);
    }
  }
});

test("the error of a plane is the noise of its points", () => {
  const next = random(7);
  const image = planeImage([0, 0, 1], 1, () => gaussian(next) * 0.002);
  const plane = fitPlane(pointsIn(image, IMAGE, { left: 0, top: 0, width: 320, height: 240 }, unproject, 1e6));
  near(plane.rmsM, 0.002, 0.0001);
  assert.equal(plane.points, 320 * 240);
});

test("holes and pixels beside the rectangle are no points, and a step is taken into account", () => {
  const depth = new Uint16Array(160 * 120).fill(10000);
  depth.fill(0, 0, 160 * 60);
  const half = { columns: 160, rows: 120, step: 2, unitM: 0.0001 };
  const points = pointsIn(depth, half, { left: 40, top: 100, width: 80, height: 40 }, unproject, 1e6);
  // Columns 20 to 59, rows 60 to 69 of the image that was sent.
  assert.equal(points.length, 3 * 40 * 10);
  near(points[0], (40 - PINHOLE.cx) / PINHOLE.fx, 1e-9);
  near(points[1], (120 - PINHOLE.cy) / PINHOLE.fy, 1e-9);
  assert.ok(pointsIn(depth, half, { left: 0, top: 0, width: 320, height: 240 }, unproject, 500).length <= 3 * 600);
});

test("too few points and points on a line have no plane", () => {
  assert.equal(fitPlane(new Float64Array(30)), null);
  assert.equal(fitPlane(Float64Array.from({ length: 300 }, (_, i) => [i, 2 * i, 1][i % 3])), null);
});

test("a rectangle stays in the image and never gets too small", () => {
  assert.deepEqual(insideImage({ left: -5, top: 300, width: 2, height: 20 }, 320, 240), { left: 0, top: 220, width: 8, height: 20 });
  assert.deepEqual(insideImage({ left: 0, top: 0, width: 999, height: 999 }, 320, 240), { left: 0, top: 0, width: 320, height: 240 });
});

test("only the enlarged stream is measured, and only when somebody looks at the numbers", () => {
  const tiles = ["a/color", "a/depth"].map((id) => ({ id, isOnScreen: true }));
  assert.deepEqual(watchOf(tiles, tiles[0], null, true).map(({ measure }) => measure), [true, undefined]);
  assert.deepEqual(watchOf(tiles, tiles[0], null).map(({ measure }) => measure), [undefined, undefined]);
});
