// A dataset read with JavaScript readers that are not ours: @mcap/core through its index and as a stream,
// checksums validated, messages taken apart by Foxglove's ROS 2 libraries.
//
// usage: node check_node.mjs DATASET EXPECTED
//
// EXPECTED is a folder with index.json and bare pixels as `tests/src/expected.rs` writes it. Lossless
// images must agree bit by bit, JPEGs within 35 dB of what depthrig itself decodes (jpeg-js rounds more
// coarsely than the decoders in common use). Exits with 1 and names the image that differs otherwise.

import assert from "node:assert/strict";
import { open, readFile, readdir } from "node:fs/promises";
import { join } from "node:path";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import jpeg from "jpeg-js";

const [dataset, expected] = process.argv.slice(2);
if (dataset == undefined || expected == undefined) {
  console.error("usage: node check_node.mjs DATASET EXPECTED");
  process.exit(2);
}

const index = JSON.parse(await readFile(join(expected, "index.json"), "utf8"));
const images = new Map();
for (const p of index.images) {
  images.set(`${p.topic} ${p.log_time}`, { ...p, pixels: await readFile(join(expected, p.file)) });
}
const names = (await readdir(dataset)).filter((n) => /^seg_\d+\.mcap$/.test(n)).sort();
assert(names.length > 0, `${dataset} has no segments`);

const motion = index.motion;

/** Numbers must be equal to the last bit; null is no number. */
function same(got, want) {
  got.forEach((g, i) => assert(want[i] === null ? Number.isNaN(g) : g === want[i], `${got} is not ${want}`));
}

/** Collects what one way of reading finds. */
class Check {
  constructor(reader) {
    this.reader = reader;
    this.seen = new Set();
    this.sets = 0n;
    this.samples = 0;
    this.batched = 0;
    this.schemas = new Map();
    this.channels = new Map();
  }

  segment() {
    this.schemas.clear();
    this.channels.clear();
  }

  channel(channel) {
    const schema = this.schemas.get(channel.schemaId);
    assert.equal(channel.messageEncoding, "cdr");
    assert.equal(schema.encoding, "ros2msg");
    const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
    this.channels.set(channel.id, { channel, reader: new MessageReader(definition) });
  }

  message(message) {
    const { channel, reader } = this.channels.get(message.channelId);
    const ros = reader.readMessage(message.data);
    if (channel.topic.endsWith("/frame_set")) {
      assert.equal(ros.id, BigInt(index.first_set) + this.sets, "set ids");
      this.sets++;
    }
    if (channel.topic.endsWith("/data_raw")) {
      this.sample(channel, message, ros);
    } else if (channel.topic.endsWith("/samples")) {
      for (const s of ros.samples) {
        const want = motion[this.batched++];
        assert.equal(String(s.time_ns), want.time_ns, `${this.reader}: sample ${want.sequence}`);
        assert.equal(s.sequence, BigInt(want.sequence));
        same([...s.gyro_rad_s, ...s.accel_m_s2], [...want.gyro, ...want.accel]);
      }
    }
    const key = `${channel.topic} ${message.logTime}`;
    const p = images.get(key);
    if (p == undefined) {
      return;
    }
    const what = `${this.reader}: ${p.topic} of set ${p.set}`;
    const stamp = BigInt(ros.header.stamp.sec) * 1_000_000_000n + BigInt(ros.header.stamp.nanosec ?? ros.header.stamp.nsec);
    assert.equal(String(stamp), p.stamp, `${what}: stamp`);
    assert.equal(message.publishTime, stamp, `${what}: publish time`);
    if (p.compare === "exact") {
      assert.equal(ros.encoding, p.encoding, what);
      assert.deepEqual([ros.width, ros.height], [p.width, p.height], what);
      assert(Buffer.compare(ros.data, p.pixels) === 0, `${what}: pixels differ`);
    } else {
      const image = jpeg.decode(ros.data, { useTArray: true, formatAsRGBA: false });
      assert.deepEqual([image.width, image.height], [p.width, p.height], what);
      let sum = 0;
      for (let i = 0; i < p.pixels.length; i++) {
        sum += (image.data[i] - p.pixels[i]) ** 2;
      }
      const psnr = 10 * Math.log10(255 ** 2 / Math.max(sum / p.pixels.length, 1e-12));
      assert(psnr > 35, `${what}: ${psnr.toFixed(1)} dB from what depthrig decodes`);
    }
    this.seen.add(key);
  }

  /** A sample of an IMU by itself. */
  sample(channel, message, ros) {
    const want = motion[this.samples++];
    assert.equal(`${channel.topic} ${message.logTime}`, `${want.base}/data_raw ${want.log_time}`);
    assert.equal(String(message.publishTime), want.stamp, `${this.reader}: time of sample ${want.sequence}`);
    const [w, a] = [ros.angular_velocity, ros.linear_acceleration];
    same([w.x, w.y, w.z, a.x, a.y, a.z], [...want.gyro, ...want.accel]);
    assert.equal(ros.orientation_covariance[0], -1);
  }

  done() {
    assert.deepEqual([this.samples, this.batched], [motion.length, motion.length], `${this.reader}: IMU samples`);
    const missing = [...images.keys()].filter((k) => !this.seen.has(k));
    assert.deepEqual(missing, [], `${this.reader}: images are missing`);
    assert.equal(this.sets, BigInt(index.sets));
    console.log(`${this.reader}: ${this.seen.size} images agree`);
  }
}

const decompressHandlers = await loadDecompressHandlers();

const indexed = new Check("@mcap/core indexed");
for (const name of names) {
  const file = await open(join(dataset, name));
  indexed.segment();
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file), decompressHandlers });
  assert.equal(reader.header.profile, "ros2");
  assert(reader.chunkIndexes.length > 0 && reader.statistics.messageCount > 0n);
  for (const schema of reader.schemasById.values()) {
    indexed.schemas.set(schema.id, schema);
  }
  for (const channel of reader.channelsById.values()) {
    indexed.channel(channel);
  }
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    indexed.message(message);
  }
  await file.close();
}
indexed.done();

const stream = new Check("@mcap/core stream");
for (const name of names) {
  stream.segment();
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(await readFile(join(dataset, name)));
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Schema") {
      stream.schemas.set(record.id, record);
    } else if (record.type === "Channel" && !stream.channels.has(record.id)) {
      stream.channel(record);
    } else if (record.type === "Message") {
      stream.message(record);
    }
  }
  assert(reader.done(), `${name} does not end with its footer`);
}
stream.done();
