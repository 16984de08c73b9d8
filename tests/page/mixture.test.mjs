import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { blendPartnerOf, isOneView, wipePartnerOf } = await load("mixture.js");

const tile = (id, isDepth, more = {}) => ({ id, camera: id.split("/")[0], isDepth, stream: { width: 640, height: 480, ...more } });
const geometry = (more = {}, k = {}) => ({
  intrinsics: { fx: 600, fy: 600, cx: 320, cy: 240, model: "none", coeffs: [], ...k },
  translation_m: [0.1, 0, 0],
  rotation_xyzw: [0, 0, 0, 1],
  ...more,
});
const color = tile("a/color", false);
const raw = tile("a/depth", true);
const refined = tile("a/depth_refined", true);
const aligned = tile("a/depth_aligned", true);
const other = tile("b/depth_refined", true);

test("colour is blended with depth of its camera and its size", () => {
  assert.equal(blendPartnerOf([color, raw, other], color), raw);
  assert.equal(blendPartnerOf([color, raw], raw), color);
  assert.equal(blendPartnerOf([color, tile("a/depth", true, { width: 320 })], color), null);
  assert.equal(blendPartnerOf([color, other], color), null);
});

test("raw depth goes with the refined one of its camera, in one view", () => {
  const all = [color, raw, refined, aligned, other];
  const same = new Map(all.map(({ id }) => [id, geometry()]));
  assert.equal(wipePartnerOf(all, raw, same), refined);
  assert.equal(wipePartnerOf(all, aligned, same), refined);
  assert.equal(wipePartnerOf(all, refined, same), aligned);
  assert.equal(wipePartnerOf([raw, refined], refined, same), raw);
  assert.equal(wipePartnerOf(all, color, same), null);
  assert.equal(wipePartnerOf([other, raw], raw, same), null);
  // Depth that was not registered to colour shows another place at each pixel.
  const apart = new Map([...same, [raw.id, geometry({ translation_m: [0.115, 0, 0] })]]);
  assert.equal(wipePartnerOf([raw, refined], raw, apart), null);
  assert.equal(wipePartnerOf([raw, refined], raw, new Map()), null, "nothing is known of their views");
});

test("one view is one lens at one place", () => {
  assert.equal(isOneView(geometry(), geometry()), true);
  assert.equal(isOneView(geometry(), undefined), false);
  for (const k of [{ fx: 601 }, { model: "rational" }, { coeffs: [0.1] }]) {
    assert.equal(isOneView(geometry(), geometry({}, k)), false, JSON.stringify(k));
  }
  assert.equal(isOneView(geometry(), geometry({ rotation_xyzw: [0, 0.01, 0, 0.99995] })), false);
});
