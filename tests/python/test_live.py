"""The WebSocket of the live page, spoken by a client that is not ours (`websockets`); test_page.py has the page in a browser."""

from __future__ import annotations

import gzip
import http.client
import io
import json
import signal
import struct
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import depthrig
import numpy as np
import pytest
from PIL import Image
from test_daemon import WAIT_S, binary, command, running, runtime, thread_named
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

__all__ = ["binary", "runtime"]

RIG = """
rig = "live"
[recording]
reserve_mb = 64
[[camera]]
name = "front"
backend = "synthetic"
model = "d435"
cheap = true
[[camera]]
name = "left"
backend = "synthetic"
model = "d455"
cheap = true
pose = { translation_m = [0.1, 0.0, 0.0] }
"""
HEAD = struct.Struct("<HBBHHHHHHQqqfI")
WALL = [{"stream": f"{c}/{s}", "width": 640, "rate_hz": 10} for c in ("front", "left") for s in ("color", "depth")]


@dataclass
class Sent:
    """An image with its head."""

    kind: int
    stream: str
    step: int
    width: int
    height: int
    full_width: int
    full_height: int
    sequence: int
    age_s: float
    unit: float
    generation: int
    payload: bytes

    @property
    def depth(self) -> np.ndarray:
        return np.frombuffer(self.payload, "<u2").reshape(self.height, self.width)


@dataclass
class Page:
    """What a page does on its connection."""

    socket: ClientConnection
    watched: list[dict]

    def say(self, **message: object) -> None:
        self.socket.send(json.dumps(message))

    def watch(self, watched: list[dict]) -> None:
        self.watched = watched
        self.say(watch=watched)

    def message(self, timeout: float = WAIT_S) -> dict | Sent:
        data = self.socket.recv(timeout)
        if isinstance(data, str):
            return json.loads(data)
        protocol, kind, zero, index, step, w, h, fw, fh, sequence, _, age, unit, generation = HEAD.unpack(data[:48])
        assert (protocol, zero) == (1, 0)
        stream = self.watched[index]["stream"]
        return Sent(kind, stream, step, w, h, fw, fh, sequence, age * 1e-9, unit, generation, data[48:])

    def image(self, credit: bool = True) -> Sent:
        while not isinstance(message := self.message(), Sent):
            pass
        if credit:
            self.say(credit=1)
        return message

    def text(self, key: str) -> dict:
        while isinstance(message := self.message(), Sent) or key not in message:
            if isinstance(message, Sent):
                self.say(credit=1)
        return message[key]


@dataclass
class Rig:
    """A running rig, and where its page is."""

    url: str
    token: str
    process_id: int

    @contextmanager
    def socket(self, **headers: str) -> Iterator[ClientConnection]:
        address = self.url.replace("http", "ws") + "v1/live"
        with connect(address, max_size=None, additional_headers=headers) as socket:
            yield socket

    @contextmanager
    def page(self, watched: list[dict] | None = None) -> Iterator[Page]:
        with self.socket() as socket:
            page = Page(socket, [])
            page.say(token=self.token)
            page.text("hello")
            if watched is not None:
                page.watch(watched)
            yield page

    def get(self, path: str, **headers: str) -> http.client.HTTPResponse:
        where = urlsplit(self.url)
        connection = http.client.HTTPConnection(where.hostname or "", where.port or 0, timeout=WAIT_S)
        connection.request("GET", path, headers=headers)
        return connection.getresponse()

    def thread(self) -> Path | None:
        """The daemon's thread that encodes."""
        return thread_named(self.process_id, "viewers")

    def encoding_ns(self) -> int:
        """The CPU time of that thread."""
        thread = self.thread()
        assert thread is not None
        return int((thread / "schedstat").read_text().split()[0])


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("live")
    (folder / "rig.toml").write_text(RIG)
    with running(binary, runtime, folder / "log", "run", str(folder / "rig.toml"), "-q") as daemon:
        until = time.monotonic() + WAIT_S
        while "streaming" not in command(binary, runtime, "status", "--json", codes=(0, 1, 3)):
            assert time.monotonic() < until
            time.sleep(0.1)
        address = json.loads(command(binary, runtime, "open", "--json"))["url"]
        url, token = address.split("#token=")
        yield Rig(url, token, daemon.pid)


def closed(socket: ClientConnection) -> tuple[int, str]:
    """Code and reason with which the server closes."""
    with pytest.raises(ConnectionClosed) as caught:
        while True:
            socket.recv(WAIT_S)
    close = caught.value.rcvd
    assert close is not None
    return close.code, close.reason


def test_images_are_those_of_the_bus(rig: Rig, runtime: Path) -> None:
    depth = depthrig.Stream("front/depth", runtime_dir=runtime, timeout=WAIT_S)
    with rig.page([{"stream": "front/depth", "width": 640, "rate_hz": 30}]) as page:
        mine: dict[int, np.ndarray] = {}
        sent: dict[int, Sent] = {}
        until = time.monotonic() + WAIT_S
        while not (both := mine.keys() & sent.keys()):
            assert time.monotonic() < until
            frame = depth.next(timeout=WAIT_S)
            assert frame is not None
            mine[frame.header.sequence] = np.array(frame.array)
            image = page.image()
            sent[image.sequence] = image
        full = mine[min(both)]
        image = sent[min(both)]
        assert (image.kind, image.full_width, image.full_height) == (2, full.shape[1], full.shape[0])
        assert image.width <= 640 and image.step == -(-full.shape[1] // 640)
        assert image.unit == pytest.approx(0.001)
        # Each pixel is one of the frame, never a mean.
        np.testing.assert_array_equal(image.depth, full[:: image.step, :: image.step][: image.height, : image.width])
        # Full size on request, with the number of the message that asked.
        page.watch([{"stream": "front/depth", "width": 0, "rate_hz": 30}])
        while (image := page.image()).generation != 2:
            pass
        assert (image.step, image.width) == (1, full.shape[1])
        page.watch([{"stream": "front/color", "width": 640, "rate_hz": 30}])
        while (image := page.image()).generation != 3:
            pass
        picture = Image.open(io.BytesIO(image.payload))
        assert picture.format == "JPEG" and picture.size == (image.width, image.height)
        assert image.kind == 1 and 0 <= image.age_s < WAIT_S


def test_rates_are_held_and_all_streams_have_their_turn(rig: Rig) -> None:
    with rig.page(WALL) as page:
        page.image()
        counts = dict.fromkeys((w["stream"] for w in WALL), 0)
        until = time.monotonic() + 4
        while time.monotonic() < until:
            counts[page.image().stream] += 1
    # 40 of each are due; a busy computer may do less, never more.
    assert max(counts.values()) <= 45, counts
    assert min(counts.values()) > 0.5 * max(counts.values()) > 2, counts


def test_a_page_without_credit_gets_nothing_and_then_the_newest(rig: Rig, runtime: Path) -> None:
    frames = depthrig.Stream(WALL[0]["stream"], runtime_dir=runtime, timeout=WAIT_S)
    with rig.page(WALL[:1]) as page:
        first = [page.image(credit=False) for _ in range(4)]
        assert len({image.sequence for image in first}) == 4
        until = time.monotonic() + 1.5
        newest = 0
        while time.monotonic() < until or newest <= first[-1].sequence + 20:
            assert time.monotonic() < until + WAIT_S, "the camera captures nothing"
            if (frame := frames.latest()) is not None:
                newest = frame.header.sequence
            assert not isinstance(page.message(), Sent), "a fifth image without credit"
        page.say(credit=1)
        # It is not one that had waited.
        assert page.image(credit=False).sequence >= newest


def test_what_a_pixel_shows_is_the_frames_depth_and_place(rig: Rig, runtime: Path) -> None:
    frame = depthrig.Stream("front/depth", runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S)
    assert frame is not None
    k = frame.header.intrinsics
    with rig.page(WALL) as page:
        for stream in WALL:
            while page.image().stream != stream["stream"]:
                pass
        page.say(pixel={"id": 7, "stream": "front/depth", "x": 600, "y": 300})
        answer = page.text("pixel")
        assert (answer["id"], answer["x"], answer["y"]) == (7, 600, 300)
        z = answer["depth_m"]
        assert z > 0
        # A pinhole without distortion, by hand; its pose is the identity but for the translation of the stream.
        ray = np.array([(600 - k.cx) / k.fx, (300 - k.cy) / k.fy, 1.0])
        place = ray * z + np.array(frame.header.pose.translation_m)
        np.testing.assert_allclose(answer["xyz_m"], place, atol=1e-4)
        seen = {s["stream"]: (s["x"], s["y"]) for s in answer["seen"]}
        assert "front/depth" not in seen
        other = depthrig.Stream("left/depth", runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S)
        assert other is not None
        o = other.header.intrinsics
        p = place - np.array(other.header.pose.translation_m)
        expected = (o.fx * p[0] / p[2] + o.cx, o.fy * p[1] / p[2] + o.cy)
        np.testing.assert_allclose(seen["left/depth"], expected, atol=0.05)
        # Outside of the image, and of a stream that is not watched: no depth.
        for stream, x in (("front/depth", 99999), ("front/none", 1)):
            page.say(pixel={"id": 8, "stream": stream, "x": x, "y": 1})
            assert page.text("pixel") | {"id": 8, "depth_m": None, "seen": []} == page_answer(stream, x)


def page_answer(stream: str, x: int) -> dict:
    return {"id": 8, "stream": stream, "x": x, "y": 1, "depth_m": None, "seen": []}


def test_the_geometry_of_a_stream_comes_once_before_its_first_image(rig: Rig, runtime: Path) -> None:
    header = depthrig.Stream("left/depth", runtime_dir=runtime, timeout=WAIT_S).next(timeout=WAIT_S).header
    with rig.page(WALL[2:]) as page:
        geometry: dict[str, dict] = {}
        for _ in range(12):
            while not isinstance(message := page.message(), Sent):
                if "geometry" in message:
                    assert message["geometry"]["stream"] not in geometry, "sent twice"
                    geometry[message["geometry"]["stream"]] = message["geometry"]
            assert message.stream in geometry
            page.say(credit=1)
    told = geometry["left/depth"]
    assert (told["width"], told["height"]) == (header.width, header.height)
    assert told["depth_unit_m"] == header.depth_unit_m
    assert told["translation_m"] == list(header.pose.translation_m)
    assert told["rotation_xyzw"] == list(header.pose.rotation_xyzw)
    k = header.intrinsics
    inside = told["intrinsics"]
    assert [inside[name] for name in ("fx", "fy", "cx", "cy")] == [k.fx, k.fy, k.cx, k.cy]
    assert inside["model"] in ("none", "brown_conrady", "inverse_brown_conrady")
    assert inside["coeffs"] == list(k.coeffs)


def test_the_numbers_of_an_image_are_those_of_the_full_frame(rig: Rig, runtime: Path) -> None:
    color = depthrig.Stream("front/color", runtime_dir=runtime, timeout=WAIT_S)
    depth = depthrig.Stream("front/depth", runtime_dir=runtime, timeout=WAIT_S)
    watched = [{"stream": f"front/{s}", "width": 64, "rate_hz": 30, "measure": True} for s in ("color", "depth")]
    with rig.page(watched) as page:
        frames: dict[tuple[str, int], np.ndarray] = {}
        told: dict[tuple[str, int], dict] = {}
        until = time.monotonic() + WAIT_S
        while len({stream for stream, _ in frames.keys() & told.keys()}) < 2:
            assert time.monotonic() < until
            for name, stream in (("front/color", color), ("front/depth", depth)):
                frame = stream.latest()
                if frame is not None:
                    frames[name, frame.header.sequence] = np.array(frame.array)
            message = page.message()
            if isinstance(message, Sent):
                page.say(credit=1)
            elif numbers := message.get("measure"):
                told[numbers["stream"], numbers["sequence"]] = numbers
        for key in frames.keys() & told.keys():
            image = frames[key]
            numbers = told[key]
            if key[0] == "front/depth":
                assert numbers["holes"] == pytest.approx(np.mean(image == 0))
                assert numbers["sharpness"] is None
                continue
            luma = (image.astype(np.uint32) @ [77, 150, 29] + 128) >> 8
            v = luma.astype(float)
            laplacian = 4 * v[1:-1, 1:-1] - v[:-2, 1:-1] - v[2:, 1:-1] - v[1:-1, :-2] - v[1:-1, 2:]
            assert numbers["sharpness"] == pytest.approx(np.mean(laplacian**2))
            np.testing.assert_allclose(numbers["luma"], np.histogram(luma, 64, (0, 256))[0] / luma.size)
            assert numbers["bright"] == pytest.approx(np.mean(image.max(axis=2) >= 254))
            assert numbers["dark"] == pytest.approx(np.mean(luma <= 1))


def test_numbers_come_at_most_five_times_a_second_and_only_if_asked_for(rig: Rig) -> None:
    for measure in (True, False):
        with rig.page([{"stream": "front/color", "width": 64, "rate_hz": 30, "measure": measure}]) as page:
            page.image()
            began = time.monotonic()
            images = numbers = 0
            while images < 60:
                message = page.message()
                if isinstance(message, Sent):
                    images += 1
                    page.say(credit=1)
                numbers += isinstance(message, dict) and "measure" in message
            assert numbers <= (5 * (time.monotonic() - began) + 2 if measure else 0)
            assert numbers > 0 or not measure


def test_nothing_is_encoded_when_nobody_watches(rig: Rig) -> None:
    with rig.page(WALL) as page:
        page.image()
        assert rig.thread()
        page.watch([])
        until = time.monotonic() + WAIT_S
        while rig.thread():
            assert time.monotonic() < until
            time.sleep(0.05)
        page.watch(WALL)
        while page.image().generation != 3:
            pass
    until = time.monotonic() + WAIT_S
    while rig.thread():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_second_page_costs_next_to_nothing(rig: Rig) -> None:
    """Encoded is once for both; when it was twice, the second cost as much as the first."""
    images = 40

    def cost(*pages: Page) -> float:
        before = rig.encoding_ns()
        for _ in range(images):
            for page in pages:
                page.image()
        return (rig.encoding_ns() - before) / images

    ratios = []
    with rig.page(WALL) as first:
        first.image()
        for _ in range(4):
            alone = cost(first)
            with rig.page(WALL) as second:
                second.image()
                ratios.append(cost(first, second) / alone)
    assert min(ratios) < 1.5, ratios


def test_a_page_that_never_reads_costs_no_memory_and_nobody_else(rig: Rig) -> None:
    def resident_mb() -> float:
        pages = int(Path(f"/proc/{rig.process_id}/statm").read_text().split()[1])
        return pages * 4096 / 1e6

    with rig.page(WALL) as page:
        for _ in range(20):
            page.image()
        before = resident_mb()
        full = [{**w, "width": 0, "rate_hz": 60} for w in WALL]
        with rig.page() as stalled:
            stalled.say(watch=full)
            # It asks for more and more, and reads nothing.
            for _ in range(50):
                stalled.say(credit=4)
                for _ in range(4):
                    page.image()
            assert resident_mb() < before + 48, (before, resident_mb())


def test_strangers_are_refused(rig: Rig) -> None:
    with rig.socket() as socket:
        socket.send(json.dumps({"token": rig.token[:-1] + "x"}))
        assert closed(socket) == (4401, "the token is wrong")
    for first in ('{"watch": []}', "{}", "hello", json.dumps({"token": ""})):
        with rig.socket() as socket:
            socket.send(first)
            assert closed(socket)[0] == 4401, first
    with rig.socket() as socket:
        assert closed(socket) == (4408, "no token came")
    # A page of another origin, and one whose name was made to point here.
    for headers, status in (
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": rig.url.rstrip("/").replace("http", "https")}, 403),
        ({"Host": "evil.example:8642"}, 403),
    ):
        with pytest.raises(InvalidStatus) as refused, rig.socket(**headers):
            pass
        assert refused.value.response.status_code == status, headers
    with rig.socket(Origin=rig.url.rstrip("/")) as socket:
        socket.send(json.dumps({"token": rig.token}))
        assert "hello" in json.loads(socket.recv(WAIT_S))
    assert rig.get("/v1/status").status == 401
    assert rig.get("/v1/status", Origin="http://evil.example", Authorization=f"Bearer {rig.token}").status == 403
    assert rig.get("/", Host="evil.example").status == 403
    assert rig.get("/v1/live", Authorization=f"Bearer {rig.token}").status == 400


def test_the_page_is_served_with_its_policy(rig: Rig) -> None:
    answer = rig.get("/")
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "require-trusted-types-for 'script'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert b"token" not in answer.headers.as_bytes() and rig.token.encode() not in answer.read()
    assert rig.get("/", **{"If-None-Match": answer.headers["etag"]}).status == 304
    # A browser gets a quarter of the bytes.
    plain = rig.get("/main.js")
    packed = rig.get("/main.js", **{"Accept-Encoding": "gzip, br"})
    assert (plain.headers["content-encoding"], packed.headers["content-encoding"]) == (None, "gzip")
    assert packed.headers["vary"] == "Accept-Encoding"
    small = packed.read()
    text = plain.read()
    assert gzip.decompress(small) == text and len(small) < len(text) / 2
    assert rig.get("/../Cargo.toml").status in (401, 404)


@pytest.mark.parametrize(
    "message",
    ["{", "[]", '{"watch": 1}', '{"dance": true}', '{"credit": -1}', '{"pixel": {"id": 1}}', '{"watch": [{"stream": "a/b"}]}'],
)
def test_messages_that_are_not_understood_end_the_connection(rig: Rig, message: str) -> None:
    with rig.page() as page:
        page.socket.send(message)
        code, reason = closed(page.socket)
        assert code == 4400 and reason


def test_streams_that_cannot_be_watched_are_named_and_the_others_go_on(rig: Rig) -> None:
    with rig.page(WALL[:1]) as page:
        page.image()
        for bad, why in (
            ([{"stream": "front", "width": 640, "rate_hz": 10}], "front"),
            ([{"stream": "front/color", "width": 640, "rate_hz": 0}], "rate_hz = 0"),
            ([{"stream": "front/color", "width": 640, "rate_hz": 1e9}], "out of range"),
            (WALL * 17, "68 streams"),
        ):
            page.say(watch=bad)
            assert why in page.text("problem")["message"]
        # A camera that is not there yet is no mistake; the others are shown.
        page.watch([{"stream": "none/color", "width": 640, "rate_hz": 10}, *WALL])
        assert page.image().stream != "none/color"


def test_eight_pages_are_served_and_a_ninth_is_told(rig: Rig) -> None:
    def open_page(pages: ExitStack) -> None:
        """Opens a page as soon as there is a place for it: those of before may be still there."""
        until = time.monotonic() + WAIT_S
        while True:
            try:
                pages.enter_context(rig.page(WALL)).image()
                return
            except ConnectionClosed:
                assert time.monotonic() < until

    with ExitStack() as pages:
        for _ in range(8):
            open_page(pages)
        with rig.socket() as socket:
            socket.send(json.dumps({"token": rig.token}))
            assert closed(socket) == (4429, "8 pages are open already")
    # Their places are free again.
    with ExitStack() as pages:
        open_page(pages)


def test_a_port_in_use_and_no_port(binary: str, runtime: Path, tmp_path: Path, rig: Rig) -> None:
    second = RIG.replace('rig = "live"', 'rig = "second"')
    (tmp_path / "second.toml").write_text(second)
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "second.toml"), "-q"):
        wait_for(binary, runtime, "second")
        url = json.loads(command(binary, runtime, "open", "--json", "--rig", "second"))["url"]
        assert not url.startswith(rig.url), "two rigs have two ports"
    off = second.replace("[recording]", '[control]\ntcp = "off"\n[recording]')
    (tmp_path / "off.toml").write_text(off)
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "off.toml"), "-q"):
        wait_for(binary, runtime, "second")
        command(binary, runtime, "open", "--print", "--rig", "second", codes=(1,))
        assert not (runtime / "second.token").exists()
    taken = second.replace("[recording]", f'[control]\ntcp = "{urlsplit(rig.url).netloc}"\n[recording]')
    (tmp_path / "taken.toml").write_text(taken.replace("localhost", "127.0.0.1"))
    command(binary, runtime, "run", str(tmp_path / "taken.toml"), "-q", codes=(1,))


def wait_for(binary: str, runtime: Path, rig: str) -> None:
    until = time.monotonic() + WAIT_S
    while rig not in command(binary, runtime, "status", "--json", "--rig", rig, codes=(0, 1, 3)):
        assert time.monotonic() < until
        time.sleep(0.1)


def test_the_end_of_the_rig_closes_its_pages(binary: str, runtime: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG.replace('rig = "live"', 'rig = "ending"'))
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "rig.toml"), "-q") as daemon:
        wait_for(binary, runtime, "ending")
        url, token = json.loads(command(binary, runtime, "open", "--json", "--rig", "ending"))["url"].split("#token=")
        with Rig(url, token, daemon.pid).page(WALL) as page, ThreadPoolExecutor(1) as beside:
            page.image()
            # What a page says while the daemon closes must not reset the connection before the reason has come.
            beside.submit(say_until_closed, page)
            daemon.send_signal(signal.SIGINT)
            assert closed(page.socket) == (1001, "the rig ends")
            daemon.wait(WAIT_S)


def say_until_closed(page: Page) -> None:
    with suppress(ConnectionClosed):
        while True:
            page.say(credit=1)
            time.sleep(0.0002)
