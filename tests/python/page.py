"""The live page in a browser: opens it, reads what is on it, and the cameras whose images are known."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Error, Locator, Page, Route
from test_daemon import WAIT_S, environment

CHROMIUM = shutil.which("chromium")
WAIT_MS = WAIT_S * 1000
WIDTH = 320
HEIGHT = 240


@dataclass(frozen=True)
class Patch:
    """A rectangle of the known image: its middle as fractions of width and height, its colour and its depth."""

    x: float
    y: float
    color: tuple[int, int, int]
    depth_mm: int


NEAR = Patch(0.25, 0.25, (200, 40, 40), 612)
FAR = Patch(0.75, 0.25, (40, 180, 60), 2987)
MIDDLE = Patch(0.25, 0.75, (50, 70, 210), 1234)
HOLE = Patch(0.75, 0.75, (128, 128, 128), 0)
PATCHES = (NEAR, FAR, MIDDLE, HOLE)

MANIFEST = """model = "pattern"
rate_hz = 10.0
"""
STREAM = """
[[stream]]
name = "{name}"
files = "{name}_*.png"
{more}intrinsics = {{ fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5, model = "none", coeffs = [] }}
"""
RIG = """rig = "{name}"
[control]
tcp = "127.0.0.1:{port}"
[recording]
directory = "datasets"
color = "raw"
reserve_mb = 64
"""
FILES = """
[[camera]]
name = "{name}"
backend = "files"
manifest = {manifest}
"""
SIMULATED = """
[[camera]]
name = "{name}"
backend = "synthetic"
model = "generic"
cheap = true
[[camera.stream]]
name = "color"
width = 320
height = 240
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 320
height = 240
rate_hz = 15.0
"""


def pattern(folder: Path, width: int = WIDTH, height: int = HEIGHT, rate_hz: float = 10.0) -> Path:
    """A camera of four patches, as a manifest of the backend `files`."""
    folder.mkdir()
    color = np.zeros((height, width, 3), np.uint8)
    depth = np.zeros((height, width), np.uint16)
    for patch in PATCHES:
        rows = slice(0, height // 2) if patch.y < 0.5 else slice(height // 2, height)
        columns = slice(0, width // 2) if patch.x < 0.5 else slice(width // 2, width)
        color[rows, columns] = patch.color
        depth[rows, columns] = patch.depth_mm
    Image.fromarray(color).save(folder / "color_1.png")
    Image.fromarray(depth).save(folder / "depth_1.png")
    manifest = folder / "camera.toml"
    streams = STREAM.format(name="color", more="") + STREAM.format(name="depth", more="depth_unit_m = 0.001\n")
    manifest.write_text(MANIFEST.replace("10.0", str(rate_hz)) + streams)
    return manifest


def files_camera(name: str, manifest: Path) -> str:
    return FILES.format(name=name, manifest=json.dumps(str(manifest)))


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@dataclass(frozen=True)
class Address:
    """What `depthrig open` prints."""

    text: str

    @property
    def origin(self) -> str:
        return self.text.partition("/#")[0]

    @property
    def port(self) -> int:
        return int(self.origin.rpartition(":")[2])

    @property
    def token(self) -> str:
        return self.text.partition("#token=")[2]


def address(binary: str, runtime: Path, rig: str) -> Address:
    """The page's address, as soon as the rig runs."""
    asked = [binary, "open", "--print", "--rig", rig]
    deadline = time.monotonic() + WAIT_S
    while True:
        done = subprocess.run(
            asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
        )
        if done.returncode == 0:
            break
        assert time.monotonic() < deadline, done.stderr
        time.sleep(0.2)
    found = re.search(r"http://localhost:\d+/#token=[0-9a-f]{64}\b", done.stdout)
    assert found, f"no address in {done.stdout!r}"
    return Address(found[0])


PAUSE_S = 0.05


def until(
    condition: Callable[[], Any],
    what: Callable[[], Any] = lambda: "",
    pause: Callable[[], None] = lambda: time.sleep(PAUSE_S),
) -> Any:
    """What `condition` returns, as soon as it is true. For what events of the browser bring use `Wall.until`."""
    deadline = time.monotonic() + WAIT_S
    while not (value := condition()):
        assert time.monotonic() < deadline, what()
        pause()
    return value


@dataclass
class Wall:
    """A page of the rig, opened in a browser."""

    page: Page
    origin: str
    problems: list[str] = field(default_factory=list)
    """Errors of the page's scripts, what its policy blocked, and dialogs, which it must not open."""
    requests: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("pageerror", lambda e: self.problems.append(f"error: {e}"))
        self.page.on("console", lambda m: self._said(m.type, m.text))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.on("dialog", lambda d: (self.problems.append(f"dialog: {d.message}"), d.dismiss()))

    def _said(self, kind: str, text: str) -> None:
        if kind == "error" and ("Content Security Policy" in text or "Trusted" in text):
            self.problems.append(text)

    def open(self, url: str) -> None:
        self.page.goto(url)

    def wait_for(self, expression: str, *arguments: Any) -> None:
        """Until a JavaScript function returns true for the arguments."""
        self.page.wait_for_function(expression, arg=list(arguments), timeout=WAIT_MS, polling=50)

    def until(self, condition: Callable[[], Any], what: Callable[[], Any] = lambda: "") -> Any:
        """As `until`, for what events bring: Playwright hands them over only during a call, and never while this thread sleeps."""
        return until(condition, what, lambda: self.page.wait_for_timeout(PAUSE_S * 1000))

    def sent(self, key: str) -> list[Any]:
        """What the page sends under this key from its next connection on; wait for it with `self.until`."""
        found: list[Any] = []

        def note(payload: str | bytes) -> None:
            message = json.loads(payload)
            if key in message:
                found.append(message[key])

        self.page.on("websocket", lambda socket: socket.on("framesent", note))
        return found

    def state(self, selector: str) -> str | None:
        return self.page.get_attribute(selector, "data-state")

    def wait_for_state(self, selector: str, state: str) -> None:
        self.wait_for("([s, t]) => document.querySelector(s)?.dataset.state === t", selector, state)

    def record_text(self) -> str:
        """All that the record bar says, for the message of a test that waited in vain."""
        return f"{self.state('#connection')}: {self.page.inner_text('#record')}"

    def press_record(self, state: str) -> None:
        """Space, as soon as the page takes it, as its button shows: not before the first status. Until the recording is in `state`."""
        until(lambda: self.page.is_enabled("#start-stop"), self.record_text)
        self.page.keyboard.press("Space")
        until(lambda: self.state("#record-state") == state, self.record_text)

    def tile(self, stream: str) -> Locator:
        return self.page.locator(f'section.tile[data-stream="{stream}"]')

    def streams(self) -> list[str]:
        return self.page.eval_on_selector_all("section.tile", "tiles => tiles.map(t => t.dataset.stream)")

    def wait_for_image(self, *streams: str) -> None:
        for stream in streams:
            self.wait_for_state(f'section.tile[data-stream="{stream}"]', "live")
            self.wait_for(HAS_IMAGE, stream)

    def colors(self, stream: str, *patches: Patch) -> list[tuple[int, int, int]]:
        """The colours in the middle of the patches, on the screen."""
        places = [self.place(stream, patch) for patch in patches]
        with Image.open(io.BytesIO(self.page.screenshot())) as screen:
            shown = screen.convert("RGB")
        return [shown.getpixel((round(x), round(y))) for x, y in places]

    def place(self, stream: str, patch: Patch) -> tuple[float, float]:
        """Where the middle of the patch is in the window."""
        x, y = self.page.evaluate(PLACE, [stream, patch.x, patch.y])
        return x, y

    def hover(self, stream: str, patch: Patch) -> None:
        """Moves the mouse over the middle of the patch."""
        x, y = self.place(stream, patch)
        self.page.mouse.move(x - 3, y - 3)
        self.page.mouse.move(x, y)

    def hovered(self) -> str:
        return self.page.inner_text("#hover")

    def drawn(self) -> int:
        """Images drawn since the page was opened."""
        return int(self.page.evaluate("window.depthrig.drawn"))

    def focus_by_keyboard(self, selector: str) -> None:
        for _ in range(60):
            if self.page.evaluate("s => document.activeElement === document.querySelector(s)", selector):
                return
            self.page.keyboard.press("Tab")
        raise AssertionError(f"Tab never comes to {selector}")

    def check(self) -> None:
        assert self.problems == []


# Something is drawn, whatever kind of context the canvas has; holes of depth are transparent.
HAS_IMAGE = """([stream]) => {
    const canvas = document.querySelector(`section.tile[data-stream="${stream}"] canvas`);
    if (!canvas || canvas.width === 0 || canvas.height === 0) return false;
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [16, 16];
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(canvas, 0, 0, 16, 16);
    return context.getImageData(0, 0, 16, 16).data.some((value, i) => i % 4 === 3 && value === 255);
}"""
# Where a place of the image is in the window: the canvas may be letterboxed.
PLACE = """([stream, x, y]) => {
    const canvas = document.querySelector(`section.tile[data-stream="${stream}"] canvas`);
    canvas.scrollIntoView({ block: "nearest" });
    const box = canvas.getBoundingClientRect();
    const fit = getComputedStyle(canvas).objectFit;
    const scales = [box.width / canvas.width, box.height / canvas.height];
    const [across, down] = fit === "contain" ? [Math.min(...scales), Math.min(...scales)] : scales;
    const width = canvas.width * across;
    const height = canvas.height * down;
    return [box.x + (box.width - width) / 2 + x * width, box.y + (box.height - height) / 2 + y * height];
}"""


PAGE_FILES = re.compile(r"^http://[^/]+/[\w.-]*(\?[^/]*)?$")
PAGE_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


def serve_from(context: BrowserContext, folder: Path) -> None:
    """Takes the page's files from a folder, with the daemon's headers: they can be tried without building it."""

    def answer(route: Route) -> None:
        parts = urlsplit(route.request.url)
        file = folder / (parts.path.strip("/") or "index.html")
        try:
            served = route.fetch(url=f"{parts.scheme}://{parts.netloc}/")
        except Error:
            route.abort()
            return
        headers = {name: value for name, value in served.headers.items() if name not in ("content-length", "etag")}
        route.fulfill(body=file.read_bytes(), headers={**headers, "content-type": PAGE_TYPES[file.suffix]})

    # A page that did not come from this computer may not speak to it.
    context.grant_permissions(["local-network-access"])
    context.route(PAGE_FILES, answer)


@contextmanager
def blank(browser: Browser, origin: str) -> Iterator[Wall]:
    """A tab of its own, with nothing in it yet; at the end nothing may have gone wrong in it."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    if "DEPTHRIG_PAGE_DIR" in os.environ:
        serve_from(context, Path(os.environ["DEPTHRIG_PAGE_DIR"]))
    try:
        context.set_default_timeout(WAIT_MS)
        wall = Wall(context.new_page(), origin)
        yield wall
        wall.check()
    finally:
        context.close()


@contextmanager
def opened(browser: Browser, where: Address) -> Iterator[Wall]:
    with blank(browser, where.origin) as wall:
        wall.open(where.text)
        wall.wait_for_state("#connection", "live")
        yield wall
