"""A viewer with Foxglove's own libraries (tests/readers/foxglove.mjs), in a process of its own."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from test_daemon import ROOT, WAIT_S, command

READERS = ROOT / "tests" / "readers"
SUBPROTOCOLS = ("foxglove.websocket.v1", "foxglove.sdk.v1")


@dataclass
class Viewer:
    """A connected viewer; it is told what to do, and says what happens."""

    process: subprocess.Popen[str]
    said: queue.Queue[dict[str, Any] | None] = field(default_factory=queue.Queue)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.put(json.loads(line))
        self.said.put(None)

    def say(self, **what: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def hear(self, timeout: float = WAIT_S) -> dict[str, Any]:
        """What happens next."""
        said = self.said.get(timeout=timeout)
        assert said is not None, "the viewer has ended"
        for channel in said.get("advertise", ()):
            self.channels[channel["topic"]] = channel
        return said

    def wait(self, kind: str, which: Callable[[Any], Any] = lambda _: True) -> Any:
        """The next thing of this kind for which `which` is true."""
        deadline = time.monotonic() + WAIT_S
        while True:
            said = self.hear(max(0.01, deadline - time.monotonic()))
            if kind in said and which(said[kind]):
                return said[kind]

    def message(self, topic: str) -> dict[str, Any]:
        """The next message of a topic."""
        return self.wait("message", lambda m: m["topic"] == topic)

    def know(self, *topics: str) -> None:
        """Waits until these topics are announced."""
        while not self.channels.keys() >= set(topics):
            self.wait("advertise")

    def subscribe(self, *topics: str) -> None:
        self.know(*topics)
        self.say(subscribe=topics)

    def during(self, seconds: float) -> list[dict[str, Any]]:
        """The messages that come in the next seconds."""
        deadline = time.monotonic() + seconds
        messages = []
        while (left := deadline - time.monotonic()) > 0:
            try:
                said = self.hear(left)
            except queue.Empty:
                break
            if "message" in said:
                messages.append(said["message"])
        return messages


@contextmanager
def viewer(url: str, protocol: str = SUBPROTOCOLS[0]) -> Iterator[Viewer]:
    """A viewer that connects to `url`."""
    process = subprocess.Popen(
        ["node", "foxglove.mjs", url, protocol],
        cwd=READERS,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield Viewer(process)
    finally:
        process.kill()
        process.wait()


def address(binary: str, runtime: Path, rig: str) -> str:
    """The address that `depthrig open --foxglove` prints, as soon as the rig runs."""
    deadline = time.monotonic() + WAIT_S
    while not (text := command(binary, runtime, "open", "--foxglove", "--rig", rig, codes=(0, 1)).strip()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return text


class _Library(SimpleHTTPRequestHandler):
    """Serves the page, and Foxglove's client as the npm package has it.

    Its modules name each other without an ending, and what it imports are CommonJS modules, which a browser does not load: `debug` is replaced, the
    emitter wrapped.
    """

    def do_GET(self) -> None:
        text = PAGES.get(self.path)
        if text is None and self.path.startswith("/ws-protocol/"):
            name = self.path.removeprefix("/ws-protocol/").removesuffix(".js")
            text = (PROTOCOL / f"{name}.js").read_text()
        elif text is None and self.path == "/eventemitter3.js":
            emitter = (READERS / "node_modules" / "eventemitter3" / "index.js").read_text()
            text = f"const module = {{ exports: {{}} }};\n{emitter}\nexport default module.exports;"
        if text is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html" if self.path == "/" else "text/javascript")
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *_: object) -> None:
        pass


PROTOCOL = READERS / "node_modules" / "@foxglove" / "ws-protocol" / "dist" / "esm" / "src"
PAGES = {
    "/debug.js": "export default () => () => {};",
    "/": """<!doctype html><title>viewer</title>
<script type="importmap">{"imports": {"debug": "/debug.js", "eventemitter3": "/eventemitter3.js"}}</script>
<script type="module">
import FoxgloveClient from "/ws-protocol/FoxgloveClient.js";
window.connect = (url, protocols) => {
  const client = new FoxgloveClient({ ws: new WebSocket(url, protocols) });
  const seen = { topics: {}, messages: {}, closed: false };
  client.on("close", () => { seen.closed = true; });
  client.on("advertise", (channels) => channels.forEach((c) => { seen.topics[c.topic] = c.id; }));
  const subscribed = new Map();
  client.on("message", ({ subscriptionId, data }) => {
    const topic = subscribed.get(subscriptionId);
    seen.messages[topic] = { bytes: data.byteLength, data, count: (seen.messages[topic]?.count ?? 0) + 1 };
  });
  seen.subscribe = (topic) => { subscribed.set(client.subscribe(seen.topics[topic]), topic); };
  window.seen = seen;
};
// CDR by hand: the last bytes of a CompressedImage are its file, behind their number.
window.pixels = async (topic, places) => {
  const { data } = window.seen.messages[topic];
  const bytes = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
  const start = bytes.findIndex((b, i) => b === 0xff && bytes[i + 1] === 0xd8);
  const image = await createImageBitmap(new Blob([bytes.subarray(start)], { type: "image/jpeg" }));
  const canvas = new OffscreenCanvas(image.width, image.height);
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  return places.map(([x, y]) => [...context.getImageData(x * image.width, y * image.height, 1, 1).data].slice(0, 3));
};
window.ready = true;
</script>""",
}


@contextmanager
def library_server() -> Iterator[str]:
    """A page of another server than the rig, with Foxglove's client in it."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Library)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
