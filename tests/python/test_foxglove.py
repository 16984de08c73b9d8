"""A running rig as viewers with Foxglove's protocol see it: the client is theirs, images are compared with what the cameras were given and with a recording.

Foxglove and Lichtblick themselves are no packages; their libraries are.
"""

from __future__ import annotations

import json
import re
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from foxglove import SUBPROTOCOLS, Viewer, address, library_server, viewer
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from page import CHROMIUM, PATCHES, SIMULATED, files_camera, free_port, pattern
from playwright.sync_api import sync_playwright
from test_daemon import ROOT, WAIT_S, binary, command, running, runtime, thread_named
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

__all__ = ["binary", "runtime"]

RIG = """rig = "{name}"
[control]
foxglove = {port}
[recording]
directory = "datasets"
reserve_mb = 64
"""
MOVING = """
[[camera]]
name = "moving"
backend = "synthetic"
model = "d455"
cheap = true
motion = true
pose = { translation_m = [0.1, 0.0, 0.2] }
# No faster than images are sent: of a faster stream each other frame is left out, which may be all that are recorded.
[[camera.stream]]
name = "color"
rate_hz = 15.0
[[camera.stream]]
name = "depth"
rate_hz = 15.0
[[camera.stream]]
name = "imu"
"""
JPEG_ERROR = 12
"""Most that a colour of an even patch changes."""
STALL_S = 4.0
STALLED_MB = 16.0
"""Most that a viewer which does not read costs the daemon."""
AGE_MS = 300.0
"""Most that an image is old, once a viewer reads again."""
ON_THE_WAY = 4
"""Images that were sent before a viewer stopped to read."""
SAMPLES_ON_THE_WAY = 400
"""Most samples of an IMU; a stall of this length has twice as many."""
CODES = (0, 3, -signal.SIGKILL)
"""A daemon may lose frames beside all this. One is killed."""
STREAMS = ("front/color", "front/depth", "moving/color", "moving/depth", "still/color", "still/depth")


def topic(stream: str, kind: str = "") -> str:
    if not kind:
        kind = "image_raw" if stream.endswith("depth") else "image_compressed"
    return f"/fox/{stream}/{kind}"


IMAGES = [topic(stream) for stream in STREAMS]


@dataclass
class Rig:
    """A running rig."""

    url: str
    folder: Path
    process_id: int

    def resident_mb(self) -> float:
        """Memory of its own: what it shares with others, such as the slots of channels, is counted again with each subscriber."""
        status = Path(f"/proc/{self.process_id}/status").read_text()
        found = re.search(r"^RssAnon:\s+(\d+) kB", status, re.MULTILINE)
        assert found
        return int(found[1]) / 1e3

    def has_thread(self) -> bool:
        """Whether the daemon has the thread that encodes."""
        return thread_named(self.process_id, "foxglove") is not None

    def wait_for_no_thread(self) -> None:
        until = time.monotonic() + WAIT_S
        while self.has_thread():
            assert time.monotonic() < until
            time.sleep(0.05)


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("foxglove")
    still = files_camera("still", pattern(folder / "still"))
    text = RIG.format(name="fox", port=free_port())
    (folder / "rig.toml").write_text(text + SIMULATED.format(name="front") + MOVING + still)
    with running(binary, runtime, folder / "log", "run", str(folder / "rig.toml"), "-q", codes=CODES) as daemon:
        yield Rig(address(binary, runtime, "fox"), folder, daemon.pid)


@pytest.fixture
def foxglove(rig: Rig) -> Iterator[Viewer]:
    with viewer(rig.url) as connected:
        yield connected


@pytest.mark.parametrize("protocol", SUBPROTOCOLS)
def test_a_viewer_is_greeted_in_both_sub_protocols(rig: Rig, protocol: str) -> None:
    with viewer(rig.url, protocol) as connected:
        assert connected.wait("open") == protocol
        info = connected.wait("info")
        assert info["name"] == "depthrig fox" and info["capabilities"] == ["services"]
        services = connected.wait("services")
        assert [s["name"] for s in services] == ["/fox/record_start", "/fox/record_stop"]
        connected.know(*IMAGES, "/tf_static", "/diagnostics", "/fox/moving/imu/data_raw")
        connected.subscribe(topic("still/depth"))
        connected.message(topic("still/depth"))


def refused(url: str, protocol: str | None = SUBPROTOCOLS[0], **headers: str) -> int:
    """The status with which a connection is refused."""
    protocols = None if protocol is None else [Subprotocol(protocol)]
    with pytest.raises(InvalidStatus) as caught, connect(url, subprotocols=protocols, additional_headers=headers):
        pass
    return caught.value.response.status_code


def test_strangers_are_refused(rig: Rig) -> None:
    base, _, token = rig.url.rpartition("/")
    assert len(token) == 64
    assert refused(rig.url, "foxglove.websocket.v2") == 400
    assert refused(rig.url, None) == 400
    for wrong in ("", "x", token[:-1], token + "0", token[:-1] + "x", f"x/{token}", f"?token={token}"):
        assert refused(f"{base}/{wrong}") == 401, wrong
    assert refused(rig.url, Host="evil.example:8765") == 403
    # Viewers in a browser come from other servers, those on the desktop from a file; both know the token.
    for origin in ("https://app.foxglove.dev", "http://localhost:8080", "file://", "null"):
        with connect(
            rig.url, subprotocols=[Subprotocol(SUBPROTOCOLS[1])], additional_headers={"Origin": origin}
        ) as socket:
            assert json.loads(socket.recv(WAIT_S))["op"] == "serverInfo"


@pytest.mark.parametrize("message", ["{", "[]", '{"op": 1}', '{"op": "subscribe"}', b"\x01", b"\x02\x00", b""])
def test_messages_that_are_not_understood_end_the_connection(rig: Rig, message: str | bytes) -> None:
    with connect(rig.url, subprotocols=[Subprotocol(SUBPROTOCOLS[0])]) as socket:
        socket.send(message)
        with pytest.raises(ConnectionClosed) as caught:
            while True:
                socket.recv(WAIT_S)
        assert caught.value.rcvd is not None and caught.value.rcvd.code == 1008


def test_subscriptions_that_cannot_be_are_named_and_unknown_requests_are_passed_over(rig: Rig) -> None:
    with connect(rig.url, subprotocols=[Subprotocol(SUBPROTOCOLS[0])]) as socket:

        def status() -> str:
            while (message := socket.recv(WAIT_S)) is not None:
                if isinstance(message, str) and (said := json.loads(message))["op"] == "status":
                    return said["message"]
            return ""

        socket.send(json.dumps({"op": "getParameters", "parameterNames": []}))
        socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 9999}]}))
        assert status() == "channel 9999 does not exist"


def test_images_are_those_that_the_cameras_were_given(foxglove: Viewer) -> None:
    foxglove.say(probe=[[p.x, p.y] for p in PATCHES])
    foxglove.subscribe(
        topic("still/color"),
        topic("still/depth"),
        topic("still/depth", "camera_info"),
        topic("still/depth", "frame_info"),
    )
    color = foxglove.message(topic("still/color"))
    assert color["ros"]["format"] == "jpeg"
    for patch, seen in zip(PATCHES, color["probed"], strict=True):
        assert max(abs(a - b) for a, b in zip(patch.color, seen, strict=True)) <= JPEG_ERROR, (patch, seen)
    depth = foxglove.message(topic("still/depth"))
    assert (depth["ros"]["encoding"], depth["ros"]["width"], depth["ros"]["height"]) == ("16UC1", 320, 240)
    assert depth["probed"] == [p.depth_mm for p in PATCHES]
    assert depth["time"] == depth["ros"]["stamp"] and depth["ros"]["frame_id"] == "still_depth_optical_frame"
    info = foxglove.message(topic("still/depth", "camera_info"))
    assert info["ros"]["k"] == [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    frame = foxglove.message(topic("still/depth", "frame_info"))
    assert frame["ros"]["depth_unit_m"] == pytest.approx(0.001) and frame["ros"]["codec"] == "raw"


def test_poses_are_sent_to_each_who_subscribes(rig: Rig, foxglove: Viewer) -> None:
    rig.wait_for_no_thread()
    for connected in (foxglove, None):
        with viewer(rig.url) as other:
            asks = connected or other
            asks.subscribe("/tf_static")
            transforms = {t["child_frame_id"]: t for t in asks.message("/tf_static")["ros"]["transforms"]}
            assert transforms.keys() >= {f"{s.replace('/', '_')}_optical_frame" for s in STREAMS}
            assert transforms["moving_depth_optical_frame"]["transform"]["translation"]["z"] == pytest.approx(0.2)
            assert all(t["header"]["frame_id"] == "fox_mount" for t in transforms.values())
    # It needs no thread.
    assert not rig.has_thread()
    foxglove.say(unsubscribe=["/tf_static"])
    foxglove.subscribe("/tf_static")
    foxglove.message("/tf_static")


def test_motion_and_diagnostics_come(foxglove: Viewer) -> None:
    foxglove.subscribe("/diagnostics", "/fox/moving/imu/data_raw")
    names = [s["name"] for s in foxglove.message("/diagnostics")["ros"]["status"]]
    assert any(name.endswith("still") for name in names), names
    samples = [foxglove.message("/fox/moving/imu/data_raw") for _ in range(200)]
    times = [int(s["time"]) for s in samples]
    assert times == sorted(set(times))
    steps = sorted(b - a for a, b in zip(times, times[1:], strict=False))
    # 200 Hz: none is left out, or few on a busy computer.
    assert steps[len(steps) // 2] < 10e6, steps
    assert samples[0]["ros"]["orientation_covariance"][0] == -1


def test_nothing_is_encoded_when_nobody_watches(rig: Rig) -> None:
    rig.wait_for_no_thread()
    with viewer(rig.url) as connected:
        connected.know(*IMAGES)
        assert not rig.has_thread()
        connected.subscribe(*IMAGES)
        connected.message(IMAGES[0])
        assert rig.has_thread()
        connected.say(unsubscribe=IMAGES)
        rig.wait_for_no_thread()
        connected.subscribe(*IMAGES)
        connected.message(IMAGES[-1])
    rig.wait_for_no_thread()


def test_rates_are_held_and_all_streams_have_their_turn(foxglove: Viewer) -> None:
    foxglove.subscribe(*IMAGES)
    foxglove.message(IMAGES[0])
    messages = foxglove.during(4)
    for image in IMAGES:
        came = [m for m in messages if m["topic"] == image]
        # 60 are due, 40 of the camera of files; a busy computer may do less, never more.
        assert len(came) > 4, image
        # All were sent after the first one was captured, and before the last one came.
        within_ms = came[-1]["at_ms"] - came[0]["at_ms"] + came[0]["age_ms"]
        assert len(came) <= 15 * within_ms / 1000 + 2, image


def test_two_viewers_do_not_disturb_each_other(rig: Rig, foxglove: Viewer) -> None:
    foxglove.subscribe(*IMAGES)
    with viewer(rig.url, SUBPROTOCOLS[1]) as other:
        other.subscribe(topic("still/depth"))
        first = other.message(topic("still/depth"))
        foxglove.message(topic("still/depth"))
        other.say(unsubscribe=[topic("still/depth")])
        foxglove.wait("message", lambda m: m["topic"] == topic("still/depth") and int(m["time"]) > int(first["time"]))
    foxglove.message(topic("front/color"))


def test_a_stalled_viewer_costs_little_and_then_sees_new_images(rig: Rig, foxglove: Viewer) -> None:
    small = "/fox/moving/imu/data_raw"
    with viewer(rig.url) as other:
        other.subscribe(*IMAGES, small)
        foxglove.subscribe(*IMAGES, small)
        for image in IMAGES:
            foxglove.message(image)
        other.during(1)
        before = rig.resident_mb()
        foxglove.say(block_ms=STALL_S * 1000)
        most = before
        until = time.monotonic() + STALL_S - 0.5
        seen = 0
        while time.monotonic() < until:
            seen += len(other.during(0.2))
            most = max(most, rig.resident_mb())
        assert seen > 20, "the other viewer goes on"
        unblocked = foxglove.wait("unblocked")
        messages = foxglove.during(3)
        images = [m for m in messages if m["topic"] in IMAGES and m["at_ms"] >= unblocked]
        assert len(images) > 10
        # On a busy computer every image is older, also those of the viewer that has not stalled.
        first = other.wait("message", lambda m: m["topic"] in IMAGES and m["at_ms"] >= unblocked)
        beside = [m["age_ms"] for m in [first, *other.during(0.1)] if m["topic"] in IMAGES]
        limit = max(AGE_MS, 1.5 * max(beside))

        def of_the_stall(messages: list[dict]) -> list[dict]:
            """Those that were captured while the viewer read nothing."""
            return [m for m in messages if m["at_ms"] - m["age_ms"] < unblocked - limit]

        old = of_the_stall(images)
        ages = sorted(m["age_ms"] for m in images if m not in old)
        print(
            f"RSS +{most - before:.1f} MB, {len(old)} old images, age p50 {ages[len(ages) // 2]:.0f}, max {ages[-1]:.0f} ms, "
            f"{max(beside):.0f} ms of the other viewer"
        )
        samples = [m for m in messages if m["topic"] == small and m["at_ms"] >= unblocked]
        assert min(m["age_ms"] for m in samples[-20:]) < limit
        old_samples = of_the_stall(samples)
        print(f"{len(old_samples)} of {len(samples)} samples are old")
        assert len(old_samples) < SAMPLES_ON_THE_WAY
        assert most - before < STALLED_MB, (before, most)
        # Those that were on their way come first; whatever comes after them is new, and stays so.
        assert len(old) <= ON_THE_WAY, [(m["topic"], m["age_ms"]) for m in old]
        assert images[: len(old)] == old
        assert len({m["topic"] for m in old}) == len(old), "one of a stream at the most"
        assert ages[len(ages) // 2] < limit, ages


def segments(path: Path) -> list[Path]:
    return sorted(path.glob("seg_*.mcap"))


def test_topics_schemas_and_bytes_are_those_of_a_recording(
    binary: str, runtime: Path, rig: Rig, foxglove: Viewer
) -> None:
    live = rig.folder / "live"
    live.mkdir()
    foxglove.say(save=str(live))
    kinds = ("", "camera_info", "frame_info")
    topics = [topic(stream, kind) for stream in STREAMS for kind in kinds] + ["/tf_static", "/fox/moving/imu/data_raw"]
    foxglove.subscribe(*topics)
    seen = foxglove.during(1)
    command(binary, runtime, "record", "start", "--rig", "fox", "--name", "beside")
    seen += foxglove.during(4)
    command(binary, runtime, "record", "stop", "--rig", "fox", codes=(0, 3))
    seen += foxglove.during(0.5)
    compared = dict.fromkeys(topics, 0)
    # Both place the host's clock in UTC by a reading of their own, microseconds apart.
    by_time = {t: {int(m["time"]) // 2_000_000: m for m in seen if m["topic"] == t} for t in topics}
    announced = foxglove.channels
    for segment in segments(rig.folder / "datasets" / "beside"):
        with segment.open("rb") as file:
            for schema, channel, message, decoded in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages(topics=topics):
                said = announced[channel.topic]
                assert (said["schemaName"], said["encoding"], said["schemaEncoding"]) == (schema.name, "cdr", "ros2msg")
                assert said["schema"] == schema.data.decode()
                if channel.topic == "/tf_static":
                    (sent,) = [m for m in seen if m["topic"] == "/tf_static"]
                    assert len(sent["ros"]["transforms"]) == len(decoded.transforms)
                    compared[channel.topic] += 1
                    continue
                place = message.publish_time // 2_000_000
                near = [by_time[channel.topic].get(place + d) for d in (0, 1, -1)]
                sent = next((m for m in near if m and abs(int(m["time"]) - message.publish_time) < 2_000_000), None)
                if sent is None:
                    continue
                payload = Path(sent["file"]).read_bytes()
                if channel.topic.endswith("frame_info"):
                    assert int(sent["ros"]["sequence"]) == decoded.sequence
                elif getattr(decoded, "format", None) != sent["ros"].get("format"):
                    continue  # a busy computer records PNG instead of JPEG
                else:
                    # The stamp is after the head of four bytes.
                    assert payload[:4] + payload[12:] == message.data[:4] + message.data[12:], channel.topic
                compared[channel.topic] += 1
    assert min(compared.values()) > 0, compared


def test_recordings_start_and_stop_by_services(binary: str, runtime: Path, rig: Rig, foxglove: Viewer) -> None:
    foxglove.wait("services")
    foxglove.say(call="/fox/record_stop")
    answer = foxglove.wait("response")
    assert not answer["success"] and "no recording" in answer["message"]
    foxglove.say(call="/fox/record_start")
    started = foxglove.wait("response")
    assert started["success"], started
    foxglove.say(call="/fox/record_start", encoding="json")
    again = foxglove.wait("response")
    assert again["encoding"] == "json" and not again["success"] and started["message"] in again["message"]
    time.sleep(1)
    foxglove.say(call="/fox/record_stop")
    stopped = foxglove.wait("response")
    assert stopped["success"] and stopped["message"].startswith(started["message"])
    command(binary, runtime, "verify", started["message"], codes=(0, 3))
    foxglove.say(call="/fox/record_stop", encoding="cbor")
    assert "cbor" in foxglove.wait("failure")["message"]


def test_eight_viewers_are_served_and_a_ninth_is_told(rig: Rig) -> None:
    def connect_viewer(sockets: ExitStack) -> None:
        """Connects a viewer as soon as there is a place for it: those of before may be still there."""
        until = time.monotonic() + WAIT_S
        while True:
            try:
                sockets.enter_context(connect(rig.url, subprotocols=[Subprotocol(SUBPROTOCOLS[0])])).recv(WAIT_S)
                return
            except ConnectionClosed:
                assert time.monotonic() < until

    with ExitStack() as sockets:
        for _ in range(8):
            connect_viewer(sockets)
        with (
            connect(rig.url, subprotocols=[Subprotocol(SUBPROTOCOLS[0])]) as ninth,
            pytest.raises(ConnectionClosed) as caught,
        ):
            ninth.recv(WAIT_S)
        assert caught.value.rcvd is not None and caught.value.rcvd.code == 1013
    with ExitStack() as sockets:
        connect_viewer(sockets)


def test_a_port_in_use_ends_the_start_and_none_is_the_default(
    binary: str, runtime: Path, tmp_path: Path, rig: Rig
) -> None:
    text = RIG.format(name="second", port=urlsplit(rig.url).port) + SIMULATED.format(name="front")
    (tmp_path / "taken.toml").write_text(text)
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "taken.toml"), "-q", codes=(1,)) as daemon:
        daemon.wait(WAIT_S)
    assert "change or remove control.foxglove" in (tmp_path / "log").read_text()
    off = text.replace(f"foxglove = {urlsplit(rig.url).port}", "")
    (tmp_path / "off.toml").write_text(off)
    with running(binary, runtime, tmp_path / "log", "run", str(tmp_path / "off.toml"), "-q", codes=CODES):
        until = time.monotonic() + WAIT_S
        while "streaming" not in command(binary, runtime, "status", "--json", "--rig", "second", codes=(0, 1, 3)):
            assert time.monotonic() < until
            time.sleep(0.1)
        command(binary, runtime, "open", "--foxglove", "--rig", "second", codes=(1,))


def test_a_killed_daemon_closes_and_the_next_one_has_another_token(binary: str, runtime: Path, tmp_path: Path) -> None:
    text = RIG.format(name="killed", port='"off"') + SIMULATED.format(name="front")
    (tmp_path / "rig.toml").write_text(text)
    port = free_port()
    start = ("run", str(tmp_path / "rig.toml"), "-q", f"--foxglove={port}")
    image = "/killed/front/depth/image_raw"
    with running(binary, runtime, tmp_path / "log", *start, codes=CODES) as daemon:
        url = address(binary, runtime, "killed")
        assert urlsplit(url).port == port
        with viewer(url) as connected:
            connected.subscribe(image)
            connected.message(image)
            daemon.kill()
            connected.wait("close")
    with running(binary, runtime, tmp_path / "log", *start, codes=CODES) as daemon:
        again = address(binary, runtime, "killed")
        until = time.monotonic() + WAIT_S
        while again == url:
            assert time.monotonic() < until
            again = address(binary, runtime, "killed")
        assert refused(url) == 401
        with viewer(again) as connected:
            connected.subscribe(image)
            connected.message(image)
            daemon.send_signal(signal.SIGINT)
            connected.wait("close", lambda code: code == 1001)
            daemon.wait(WAIT_S)


def test_a_replay_is_seen_with_the_times_of_its_dataset(binary: str, runtime: Path, tmp_path: Path, rig: Rig) -> None:
    text = RIG.format(name="played", port='"off"') + files_camera("still", rig.folder / "still" / "camera.toml")
    (tmp_path / "rig.toml").write_text(text)
    record = ("run", str(tmp_path / "rig.toml"), "-q", "--record", str(tmp_path / "out"), "--seconds", "3")
    with running(binary, runtime, tmp_path / "log", *record, codes=CODES) as daemon:
        daemon.wait(WAIT_S)
    (dataset,) = (tmp_path / "out").iterdir()
    recorded = set()
    for segment in segments(dataset):
        with segment.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=["/played/still/depth/image_raw"]):
                recorded.add(message.publish_time)
    play = ("replay", str(dataset), "--loop", f"--foxglove={free_port()}")
    with running(binary, runtime, tmp_path / "log", *play, codes=CODES):
        with viewer(address(binary, runtime, "played")) as connected:
            connected.say(probe=[[p.x, p.y] for p in PATCHES])
            connected.subscribe("/played/still/depth/image_raw", "/tf_static")
            depth = connected.message("/played/still/depth/image_raw")
            assert depth["probed"] == [p.depth_mm for p in PATCHES]
            assert min(abs(int(depth["time"]) - t) for t in recorded) < 1000


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")
@pytest.mark.parametrize("protocol", SUBPROTOCOLS)
def test_a_page_of_another_server_sees_the_images_in_chromium(rig: Rig, protocol: str) -> None:
    color = topic("still/color")
    with library_server() as page_url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        try:
            page = browser.new_page()
            page.set_default_timeout(WAIT_S * 1000)
            problems: list[str] = []
            page.on("pageerror", lambda e: problems.append(str(e)))
            page.goto(page_url)
            page.wait_for_function("window.ready")
            page.evaluate("([url, protocol]) => window.connect(url, [protocol])", [rig.url, protocol])
            page.wait_for_function("t => window.seen.topics[t] !== undefined", arg=color)
            page.evaluate("t => window.seen.subscribe(t)", color)
            page.wait_for_function("t => window.seen.messages[t]?.count >= 5", arg=color)
            places = [[p.x, p.y] for p in PATCHES]
            for patch, seen in zip(
                PATCHES, page.evaluate("([t, p]) => window.pixels(t, p)", [color, places]), strict=True
            ):
                assert max(abs(a - b) for a, b in zip(patch.color, seen, strict=True)) <= JPEG_ERROR, (patch, seen)
            # Without the token a page is told nothing.
            page.evaluate("([url, protocol]) => window.connect(url, [protocol])", [rig.url[:-1], protocol])
            page.wait_for_function("window.seen.closed")
            assert page.evaluate("Object.keys(window.seen.topics).length") == 0
            assert problems == []
        finally:
            browser.close()


def layout_names(value: object) -> Iterator[str]:
    """Every text in the layout that names a topic or a service."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from layout_names(key)
            yield from layout_names(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from layout_names(inner)
    elif isinstance(value, str) and value.startswith("/"):
        yield value


def panels(layout: object) -> Iterator[str]:
    """The panels that a tree of a layout shows."""
    if isinstance(layout, str):
        yield layout
    elif isinstance(layout, dict):
        yield from panels(layout["first"])
        yield from panels(layout["second"])


def test_the_layout_is_one_of_the_default_rig(binary: str, runtime: Path, tmp_path: Path) -> None:
    layout = json.loads((ROOT / "tools" / "foxglove" / "depthrig.json").read_text())
    configs = layout["configById"]
    tabs = [t["layout"] for c in configs.values() for t in c.get("tabs", ())]
    shown = [name for tree in (layout["layout"], *tabs) for name in panels(tree)]
    assert sorted(shown) == sorted(configs), "each panel is shown once"
    kinds = [name.partition("!")[0] for name in shown]
    assert kinds.count("Image") == 14 and {"3D", "DiagnosticSummary", "CallService"} <= set(kinds)
    # Simple images: rendering the scenes takes minutes.
    default = command(binary, runtime, "config", "show")
    cheap = re.sub(r"^model = ", "cheap = true\nmodel = ", default, flags=re.MULTILINE)
    (tmp_path / "rig.toml").write_text(cheap)
    start = ("run", str(tmp_path / "rig.toml"), "-q", f"--foxglove={free_port()}")
    with (
        running(binary, runtime, tmp_path / "log", *start, codes=CODES),
        viewer(address(binary, runtime, "mount")) as connected,
    ):
        services = {s["name"] for s in connected.wait("services")}
        connected.know(*(set(layout_names(layout)) - services))
        images = [t for t in set(layout_names(layout)) if t.endswith("image_compressed")]
        connected.subscribe(*images)
        for image in images:
            connected.wait("message", lambda m, image=image: m["topic"] == image)
