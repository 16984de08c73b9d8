// A viewer of a running rig that is not ours: @foxglove/ws-protocol connects, Foxglove's ROS 2 libraries take the messages apart.
//
// usage: node foxglove.mjs URL [SUBPROTOCOL]
//
// Standard input has commands, standard output what happens, a JSON object a line each:
//   {"subscribe": [TOPIC, …]}   {"unsubscribe": [TOPIC, …]}
//   {"probe": [[X, Y], …]}      images come with their values at these places, fractions of width and height
//   {"save": FOLDER}            payloads go into files there
//   {"block_ms": N}             nothing is read and answered for so long
//   {"call": SERVICE}           calls it; {"call": SERVICE, "encoding": "json"} as JSON

import { writeFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { parse } from "@foxglove/rosmsg";
import { MessageReader, MessageWriter } from "@foxglove/rosmsg2-serialization";
import protocol from "@foxglove/ws-protocol";
import jpeg from "jpeg-js";
import WebSocket from "ws";

const { FoxgloveClient } = protocol;

const nanoseconds = (t) => BigInt(t.sec) * 1_000_000_000n + BigInt(t.nanosec ?? t.nsec);

/** The values of an image at some places. */
function probed(ros, places) {
  if (ros.format === "jpeg") {
    const image = jpeg.decode(ros.data, { useTArray: true, formatAsRGBA: false });
    return places.map(([x, y]) => {
      const at = 3 * (Math.floor(y * image.height) * image.width + Math.floor(x * image.width));
      return [...image.data.subarray(at, at + 3)];
    });
  }
  const view = new DataView(ros.data.buffer, ros.data.byteOffset, ros.data.byteLength);
  return places.map(([x, y]) => {
    const row = Math.floor(y * ros.height) * ros.step;
    const column = Math.floor(x * ros.width);
    switch (ros.encoding) {
      case "16UC1":
        return view.getUint16(row + 2 * column, true);
      case "rgb8":
        return [0, 1, 2].map((c) => view.getUint8(row + 3 * column + c));
      default:
        return null;
    }
  });
}

/** What a message says, without the long parts. */
function summary(ros) {
  const short = {};
  for (const [key, value] of Object.entries(ros)) {
    if (key === "header") {
      short.frame_id = value.frame_id;
      short.stamp = String(nanoseconds(value.stamp));
    } else if (ArrayBuffer.isView(value)) {
      short[key] = value.length > 64 ? value.length : [...value].map((v) => (typeof v === "bigint" ? String(v) : v));
    } else if (key === "stamp") {
      short.stamp = String(nanoseconds(value));
    } else {
      short[key] = value;
    }
  }
  return short;
}

class Viewer {
  constructor(url, protocols, say) {
    this.say = say;
    this.probe = [];
    this.channels = new Map();
    this.subscriptions = new Map();
    this.services = new Map();
    this.calls = 0;
    const socket = new WebSocket(url, protocols);
    const client = new FoxgloveClient({ ws: socket });
    this.client = client;
    client.on("open", () => say({ open: socket.protocol }));
    client.on("error", () => say({ error: true }));
    client.on("close", (event) => say({ close: event?.code ?? 0 }));
    client.on("serverInfo", (info) => say({ info }));
    client.on("status", (status) => say({ status }));
    client.on("advertise", (channels) => {
      for (const channel of channels) {
        const reader = new MessageReader(parse(channel.schema, { ros2: true }));
        this.channels.set(channel.topic, { channel, reader });
      }
      say({ advertise: channels });
    });
    client.on("unadvertise", (ids) => say({ unadvertise: ids }));
    client.on("advertiseServices", (services) => {
      for (const service of services) {
        this.services.set(service.name, service);
      }
      say({ services });
    });
    client.on("message", (message) => this.message(message));
    client.on("serviceCallResponse", (response) => this.response(response));
    client.on("serviceCallFailure", (failure) => say({ failure }));
  }

  message({ subscriptionId, timestamp, data }) {
    const now = Date.now();
    const topic = this.subscriptions.get(subscriptionId);
    if (topic == undefined) {
      this.say({ stray: subscriptionId });
      return;
    }
    const ros = this.channels.get(topic).reader.readMessage(data);
    const said = {
      topic,
      time: String(timestamp),
      age_ms: now - Number(timestamp / 1000n) / 1000,
      at_ms: now,
      bytes: data.byteLength,
      ros: summary(ros),
    };
    if (ros.data != undefined && this.probe.length > 0) {
      said.probed = probed(ros, this.probe);
    }
    const payload = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
    this.say({ message: said }, payload);
  }

  call(name, encoding = "cdr") {
    const service = this.services.get(name);
    const request = encoding === "json"
      ? new TextEncoder().encode("{}")
      : new MessageWriter(parse(service.request.schema, { ros2: true })).writeMessage({});
    const data = new DataView(request.buffer, request.byteOffset, request.byteLength);
    this.client.sendServiceCallRequest({ serviceId: service.id, callId: ++this.calls, encoding, data });
  }

  response({ serviceId, callId, encoding, data }) {
    const service = [...this.services.values()].find((s) => s.id === serviceId);
    const bytes = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
    const response = encoding === "json"
      ? JSON.parse(new TextDecoder().decode(bytes))
      : new MessageReader(parse(service.response.schema, { ros2: true })).readMessage(bytes);
    this.say({ response: { name: service.name, callId, encoding, ...response } });
  }

  subscribe(topic) {
    this.subscriptions.set(this.client.subscribe(this.channels.get(topic).channel.id), topic);
  }

  unsubscribe(topic) {
    for (const [id, subscribed] of this.subscriptions) {
      if (subscribed === topic) {
        this.client.unsubscribe(id);
      }
    }
  }

  command(command) {
    command.subscribe?.forEach((topic) => this.subscribe(topic));
    command.unsubscribe?.forEach((topic) => this.unsubscribe(topic));
    if (command.probe) {
      this.probe = command.probe;
    }
    if (command.call) {
      this.call(command.call, command.encoding);
    }
  }
}

const [url, subprotocol] = process.argv.slice(2);
let folder;
let saved = 0;
const say = (said, payload) => {
  if (payload && folder) {
    said.message.file = `${folder}/${saved++}`;
    writeFileSync(said.message.file, payload);
  }
  process.stdout.write(`${JSON.stringify(said, (_, v) => (typeof v === "bigint" ? String(v) : v))}\n`);
};
const viewer = new Viewer(url, subprotocol ?? FoxgloveClient.SUPPORTED_SUBPROTOCOL, say);
for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  folder = command.save ?? folder;
  viewer.command(command);
  if (command.block_ms) {
    Atomics.wait(new Int32Array(new SharedArrayBuffer(4)), 0, 0, command.block_ms);
    say({ unblocked: Date.now() });
  }
}
process.exit(0);
