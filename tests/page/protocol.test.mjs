import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { HEAD_BYTES, depthOf, jpegOf, parseImage, parseText, pixelMessage, tokenMessage, watchMessage } = await load("protocol.js");

function message({ protocol = 1, kind = 2, columns = 2, rows = 3, payload = 2 * columns * rows } = {}) {
  const bytes = new ArrayBuffer(HEAD_BYTES + payload);
  const head = new DataView(bytes);
  head.setUint16(0, protocol, true);
  head.setUint8(2, kind);
  head.setUint16(4, 5, true);
  head.setUint16(6, 4, true);
  head.setUint16(8, columns, true);
  head.setUint16(10, rows, true);
  head.setUint16(12, 8, true);
  head.setUint16(14, 12, true);
  head.setBigUint64(16, 2n ** 60n, true);
  head.setBigInt64(24, 123_456_789_000n, true);
  head.setBigInt64(32, 41_500_000n, true);
  head.setFloat32(40, 0.001, true);
  head.setUint32(44, 7, true);
  return bytes;
}

test("each field of the head is read from its place", () => {
  const image = parseImage(message());
  assert.equal(image.kind, "depth");
  assert.equal(image.index, 5);
  assert.equal(image.step, 4);
  assert.deepEqual([image.columns, image.rows, image.fullColumns, image.fullRows], [2, 3, 8, 12]);
  assert.equal(image.sequence, 2n ** 60n);
  assert.equal(image.captureNs, 123_456_789_000n);
  assert.equal(image.ageMs, 41.5);
  assert.ok(Math.abs(image.unitM - 0.001) < 1e-9);
  assert.equal(image.watch, 7);
});

test("depth is read little endian, row by row", () => {
  const bytes = message();
  new DataView(bytes).setUint16(HEAD_BYTES + 2, 0x1234, true);
  assert.deepEqual([...depthOf(parseImage(bytes))], [0, 0x1234, 0, 0, 0, 0]);
});

test("a JPEG is what follows the head, of any length", () => {
  assert.equal(jpegOf(parseImage(message({ kind: 1, payload: 17 }))).length, 17);
});

test("messages that are not of this protocol are refused", () => {
  assert.throws(() => parseImage(new ArrayBuffer(HEAD_BYTES - 1)), /47 bytes/);
  assert.throws(() => parseImage(message({ protocol: 2 })), /protocol 2/);
  assert.throws(() => parseImage(message({ kind: 3 })), /kind of image: 3/);
  assert.throws(() => parseImage(message({ payload: 11 })), /2x3 has 11 bytes/);
});

test("text of a later server is ignored", () => {
  assert.equal(parseText('{"weather": {}}'), null);
  assert.equal(parseText("3"), null);
  assert.deepEqual(parseText('{"problem": {"message": "m"}}'), { problem: { message: "m" } });
});

test("messages to the server have one key", () => {
  assert.equal(tokenMessage('a"b'), '{"token":"a\\"b"}');
  assert.equal(pixelMessage(7, { stream: "a/depth", x: 1, y: 2 }), '{"pixel":{"id":7,"stream":"a/depth","x":1,"y":2}}');
  const many = Array.from({ length: 70 }, (_, i) => ({ stream: `c${i}/color`, width: 640, rate_hz: 10 }));
  assert.equal(JSON.parse(watchMessage(many)).watch.length, 64);
});
