import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { SIDE, ShiftMeter, shiftBetween, spectrumOf } = await load("shift.js");
const { shiftState, shiftText } = await load("referencetext.js");

/** The same numbers in every run. */
function random(seed) {
  let state = seed;
  return () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return state / 2 ** 32;
  };
}

/** A texture of waves: it can be shifted by any part of a pixel without being sampled again. */
function texture(seed, count = 120, longest = 200, shortest = 6) {
  const next = random(seed);
  const waves = Array.from({ length: count }, () => {
    const length = shortest * (longest / shortest) ** next();
    const angle = 2 * Math.PI * next();
    return [(Math.cos(angle) * 2 * Math.PI) / length, (Math.sin(angle) * 2 * Math.PI) / length, 2 * Math.PI * next()];
  });
  return (x, y) => waves.reduce((sum, [u, v, phase]) => sum + Math.sin(u * x + v * y + phase), 0) / Math.sqrt(count);
}

function draw(of, columns, rows, dx, dy, noise = 0, seed = 1) {
  const next = random(seed);
  const luma = new Uint8Array(columns * rows);
  for (let y = 0; y < rows; y++) {
    for (let x = 0; x < columns; x++) {
      const level = 128 + 40 * of(x - dx, y - dy) + noise * (next() + next() + next() - 1.5);
      luma[y * columns + x] = Math.min(255, Math.max(0, Math.round(level)));
    }
  }
  return { luma, columns, rows };
}

const near = (shift, dx, dy, tolerance) => {
  const away = Math.hypot(shift.dx - dx, shift.dy - dy);
  assert.ok(away <= tolerance, `${shift.dx} ${shift.dy} is ${away} from ${dx} ${dy}`);
};

test("shifts of parts of a pixel are found to a twentieth of one", () => {
  const of = texture(1);
  const meter = new ShiftMeter(draw(of, 240, 180, 0, 0));
  for (const [dx, dy] of [[0, 0], [0.3, -0.4], [3.25, 1.5], [-7.6, 11.2], [25.5, -18.1]]) {
    const shift = meter.measure(draw(of, 240, 180, dx, dy, 6, 7));
    assert.equal(shift.certainty, "sure", `${dx} ${dy}: ${JSON.stringify(shift)}`);
    near(shift, dx, dy, 0.05);
  }
});

test("a large image is measured at its own resolution", () => {
  const of = texture(2, 40);
  const meter = new ShiftMeter(draw(of, 600, 400, 0, 0));
  for (const [dx, dy] of [[0.5, 0.25], [-13.4, 6.7]]) {
    const shift = meter.measure(draw(of, 600, 400, dx, dy, 6, 3));
    assert.equal(shift.certainty, "sure", JSON.stringify(shift));
    near(shift, dx, dy, 0.05);
  }
});

test("noise is no shift, nor is an even image or another scene", () => {
  const scene = draw(texture(3), 240, 180, 0, 0);
  const even = draw(() => 0, 240, 180, 0, 0);
  const ofNoise = (seed) => draw(() => 0, 240, 180, 0, 0, 30, seed);
  for (const [before, after] of [[even, even], [scene, even], [even, scene], [ofNoise(1), ofNoise(2)], [scene, ofNoise(3)], [scene, draw(texture(4), 240, 180, 0, 0)]]) {
    const shift = new ShiftMeter(before).measure(after);
    assert.equal(shift.certainty, "none", JSON.stringify(shift));
  }
});

test("a faint pattern of the sensor is no scene that stands still", () => {
  const next = random(11);
  const luma = Uint8Array.from({ length: 240 * 180 }, () => (next() < 0.05 ? 129 : 128));
  const image = { luma, columns: 240, rows: 180 };
  assert.equal(new ShiftMeter(image).measure(image).certainty, "none");
});

test("half of the scene may be another one, and the light may change", () => {
  const of = texture(5);
  const meter = new ShiftMeter(draw(of, 240, 180, 0, 0));
  const moved = draw(of, 240, 180, 4.5, -2.25, 6, 2);
  const other = draw(texture(6), 240, 180, 0, 0);
  for (let y = 0; y < 180; y++) {
    for (let x = 0; x < 240; x++) {
      const i = y * 240 + x;
      moved.luma[i] = x < 80 ? other.luma[i] : moved.luma[i] * 0.6 + 20;
    }
  }
  const shift = meter.measure(moved);
  assert.notEqual(shift.certainty, "none");
  near(shift, 4.5, -2.25, 0.3);
});

test("an image whose halves have moved differently is not sure", () => {
  const of = texture(10);
  const before = draw(of, 240, 180, 0, 0);
  const after = draw(of, 240, 180, 0, 0, 6, 2);
  const moved = draw(of, 240, 180, 9, 4, 6, 3);
  after.luma.set(moved.luma.subarray(0, 90 * 240));
  const shift = new ShiftMeter(before).measure(after);
  assert.equal(shift.certainty, "unsure", JSON.stringify(shift));
});

test("the transform is that of its definition", () => {
  const next = random(9);
  const image = { luma: Uint8Array.from({ length: 12 * 9 }, () => 255 * next()), columns: 12, rows: 9 };
  const { re, im } = spectrumOf(image, { left: 0, top: 0, width: 12, height: 9 });
  const mean = image.luma.reduce((sum, level) => sum + level, 0) / image.luma.length;
  const hann = (i, n) => 0.5 - 0.5 * Math.cos((2 * Math.PI * (i + 0.5)) / n);
  for (const [u, v] of [[0, 0], [1, 0], [0, 3], [17, 200], [255, 128]]) {
    let real = 0;
    let imaginary = 0;
    image.luma.forEach((level, i) => {
      const [x, y] = [i % 12, Math.floor(i / 12)];
      const value = (level - mean) * hann(x, 12) * hann(y, 9);
      const angle = (-2 * Math.PI * (u * x + v * y)) / SIDE;
      real += value * Math.cos(angle);
      imaginary += value * Math.sin(angle);
    });
    assert.ok(Math.hypot(re[v * SIDE + u] - real, im[v * SIDE + u] - imaginary) < 0.01, `${u} ${v}`);
  }
});

test("the other way round the shift is the other way", () => {
  const of = texture(8);
  const part = { left: 0, top: 0, width: 200, height: 150 };
  const a = spectrumOf(draw(of, 200, 150, 0, 0), part);
  const b = spectrumOf(draw(of, 200, 150, 5, -3), part);
  const back = shiftBetween(b, a);
  near(shiftBetween(a, b), -back.dx, -back.dy, 0.05);
});

test("a shift is said with how sure it is", () => {
  const shift = { dx: 3.24, dy: -0.04, certainty: "sure", score: 50 };
  assert.equal(shiftText(shift), "Shift dx +3.2, dy −0.0 px (sure)");
  assert.equal(shiftText({ ...shift, certainty: "unsure" }), "Shift dx +3.2, dy −0.0 px (not sure)");
  assert.match(shiftText({ ...shift, certainty: "none" }), /^No shift found/);
  assert.equal(shiftText(null), "measuring");
  assert.deepEqual([shift, { ...shift, dx: 0.2 }, { ...shift, certainty: "unsure" }, null].map(shiftState), ["moved", "still", "unknown", "unknown"]);
});
