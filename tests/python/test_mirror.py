"""Live frames of another computer, read by the package depthrig as those of this one: which, when, and what is said while none come.

The two computers have clocks that are apart by a known time, so that each frame's time here has a truth.
"""

from __future__ import annotations

import json
import re
import threading
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import depthrig
import numpy as np
import pytest
from test_daemon import WAIT_S, binary
from test_hosts import HOST_CAMERAS, Rig, two_computers, wait_for
from test_link_clock import SHIFT_NS

__all__ = ["binary"]

STREAMS = ["moving/color", "moving/depth"]
MOVING = """
[[camera]]
name = "moving"
backend = "synthetic"
model = "d455"
cheap = true
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 30.0
[[camera.stream]]
name = "depth"
width = 640
height = 480
rate_hz = 30.0
"""


@pytest.fixture
def rig(binary: str, tmp_path: Path) -> Iterator[Rig]:  # noqa: F811
    with two_computers(binary, tmp_path, "10gbit", mirror=[*STREAMS, "moving/infra_none"], more=MOVING) as rig:
        yield rig


def mirrors(rig: Rig) -> dict[str, dict[str, Any]]:
    return {m["stream"]: m for m in rig.host()["mirrors"]}


def wait_for_mirror(rig: Rig, stream: str, state: str, seconds: float = WAIT_S, **has: object) -> dict[str, Any]:
    def found() -> dict[str, Any] | None:
        mirror = mirrors(rig)[stream]
        return mirror if mirror["state"] == state and all(mirror[k] == v for k, v in has.items()) else None

    return wait_for(f"{stream} is {state}, {has}", found, seconds)


@contextmanager
def read(rig: Rig) -> Iterator[None]:
    """What is read here is asked for: a subscriber of each stream, whose frames are left unread."""
    with ExitStack() as stack:
        for stream in STREAMS:
            stack.enter_context(depthrig.Stream(stream, "mount", rig.runtime["here"], timeout=WAIT_S))
        yield


Frames = dict[int, tuple[Any, np.ndarray]]
"""The last frames of a stream, by the camera's own numbers."""
KEPT = 60


def keep(frames: Frames, source: depthrig.Stream) -> None:
    with source.next(timeout=WAIT_S) as frame:
        frames[frame.header.device_sequence] = (frame.header, np.array(frame.array))
    if len(frames) > KEPT:
        del frames[min(frames)]


@contextmanager
def kept(source: depthrig.Stream) -> Iterator[Frames]:
    """Its last frames, read beside: all of them, however few are mirrored."""
    frames: Frames = {}
    is_over = threading.Event()

    def read() -> None:
        while not is_over.is_set():
            keep(frames, source)

    with ThreadPoolExecutor(1) as beside:
        reading = beside.submit(read)
        try:
            yield frames
        finally:
            is_over.set()
            reading.result()


def both(rig: Rig, stream: str, count: int) -> list[tuple[Any, np.ndarray, Any, np.ndarray]]:
    """Frames that were read on both computers."""
    out: list[tuple[Any, np.ndarray, Any, np.ndarray]] = []
    with (
        depthrig.Stream(stream, "mount", rig.runtime["here"], timeout=WAIT_S) as here,
        depthrig.Stream(stream, "mount", rig.runtime["there"], timeout=WAIT_S) as there,
        kept(there) as originals,
    ):
        mirrored: Frames = {}
        deadline = time.monotonic() + WAIT_S
        while len(out) < count:
            assert time.monotonic() < deadline, f"{len(out)} frames of {stream} came; {mirrors(rig)[stream]}"
            keep(mirrored, here)
            for number in list(mirrored):
                if (original := originals.get(number)) is not None:
                    out.append((*mirrored.pop(number), *original))
    return out


def both_raw(rig: Rig, stream: str, count: int, carried: list[str]) -> list[tuple[Any, np.ndarray, Any, np.ndarray]]:
    """Frames that were read on both computers while those that are `carried` came as they are."""
    # A computer that is busy carries them small for some seconds, and at last for a minute.
    for _ in range(5):
        for name in carried:
            wait_for_mirror(rig, name, "live", 3 * WAIT_S, coding="raw")
        codings = set()
        with ThreadPoolExecutor(1) as beside:
            reading = beside.submit(both, rig, stream, count)
            is_over = False
            while not is_over:
                is_over = bool(wait([reading], 0.5).done)
                seen = mirrors(rig)
                codings |= {seen[name]["coding"] for name in carried}
        frames = reading.result()
        if codings == {"raw"}:
            break
    return frames


def check_headers(rig: Rig, frames: list[tuple[Any, np.ndarray, Any, np.ndarray]]) -> None:
    for h, _, o, _ in frames:
        wrong_ns = h.capture_time_ns - (o.capture_time_ns - SHIFT_NS)
        assert abs(wrong_ns) <= h.capture_uncertainty_ns - o.capture_uncertainty_ns < 5_000_000
        assert h.captured == h.sequence + sum(h.dropped)
        assert (h.camera, h.stream, h.serial, h.intrinsics, h.pose) == (o.camera, o.stream, o.serial, o.intrinsics, o.pose)
        assert h.capture_time_ns < h.publish_time_ns


def test_frames_are_here_as_they_are_there(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    assert mirrors(rig)["moving/color"]["state"] in ("waiting", "live", "unread")
    wait_for("the clock", lambda: rig.host()["has_clock"])
    for stream in STREAMS:
        with read(rig):
            frames = both_raw(rig, stream, 30, [stream])
            check_headers(rig, frames)
            wait_for("the coding", lambda: " Hz from left as raw" in rig.ask("status", codes=(3,)), 3 * WAIT_S)
        assert all(np.array_equal(here, there) for _, here, _, there in frames)
        assert len({here.tobytes() for _, here, _, _ in frames}) > 20, "the images change"
    # A stream that nobody has is said to be one, and harms no other.
    absent = wait_for_mirror(rig, "moving/infra_none", "waiting", why="nobody publishes it there")
    assert absent["frames"] == 0
    absent_text = "mirror  moving/infra_none: waits for left: nobody publishes it there"
    wait_for("the reason", lambda: absent_text in rig.ask("status", codes=(3,)))
    # Readers here are no readers there, and the other way round.
    listed = {"moving/color", "moving/depth"}
    wait_for("the streams in the list", lambda: listed <= set(depthrig.streams("mount", rig.runtime["here"])))
    one_moment(rig)
    nobody_reads(rig)


def one_moment(rig: Rig) -> None:
    """Frames of both computers at one moment, as a policy reads them: cameras that run freely at 30 Hz."""
    own = f"{HOST_CAMERAS['here'][0].name}/color"
    with depthrig.SetReader([own, *STREAMS], "mount", rig.runtime["here"], timeout=WAIT_S) as reader:
        skews = []
        before = -1
        deadline = time.monotonic() + WAIT_S
        while len(skews) < 20:
            assert time.monotonic() < deadline, f"frames are lost all the time: {skews}"
            with reader.next(timeout=WAIT_S) as group:
                assert group.is_complete and group.skew_s <= 0.05
                # The frame that is nearest may be one that a busy computer has lost.
                lost = sum(sum(frame.header.dropped) for frame in group.values()) + sum(reader.missed.values())
                if lost == before:
                    skews.append(group.skew_s)
                before = lost
    # 2/3 of a period, how far apart the two streams of one camera are, and what the offset of the clocks may be wrong by.
    assert np.median(skews) < 0.0235, skews


def nobody_reads(rig: Rig) -> None:
    """A stream without a reader is not carried; its next reader gets no frame of before, and loses none."""

    def carried() -> int:
        (line,) = [line for line in rig.hosts.run("here", "cat", "/proc/net/dev").splitlines() if "here:" in line]
        return int(line.split()[1])

    unread = {stream: wait_for_mirror(rig, stream, "unread", 10) for stream in STREAMS}
    rested_s = time.clock_gettime(time.CLOCK_MONOTONIC)
    assert "mirror  moving/color: nobody here reads it" in rig.ask("status", codes=(3,))
    before = carried()
    time.sleep(2)
    # Of 41 MB/s; the clock, and what asks for the state of the other computer, go on.
    assert carried() - before < 500_000
    for stream in STREAMS:
        assert mirrors(rig)[stream] == unread[stream], "no frame came"
        # The first frame may be replaced before a busy computer reads it.
        for _ in range(3):
            rests = wait_for_mirror(rig, stream, "unread", 10)
            with depthrig.Stream(stream, "mount", rig.runtime["here"], timeout=WAIT_S) as source, source.next(timeout=WAIT_S) as frame:
                h = frame.header
            assert h.capture_time_ns / 1e9 > rested_s, "a frame of before"
            assert h.captured == h.sequence + sum(h.dropped)
            if h.sequence == rests["frames"] + 1:
                break
        assert h.sequence == rests["frames"] + 1
        assert h.dropped[depthrig.DropReason.QUEUE_FULL] == rests["skipped"]


def test_a_cut_wire_and_a_killed_daemon_are_gaps_that_are_counted(rig: Rig) -> None:
    rig.start("here")
    rig.start("there")
    with depthrig.Stream("moving/depth", "mount", rig.runtime["here"], timeout=WAIT_S) as source:
        wait_for_mirror(rig, "moving/depth", "live")

        def next_header() -> Any:
            with source.next(timeout=WAIT_S) as frame:
                return frame.header

        before = next_header()
        rig.hosts.cut()
        wait_for_mirror(rig, "moving/depth", "waiting", 10)
        time.sleep(2)
        rig.hosts.heal()
        wait_for_mirror(rig, "moving/depth", "live", 20)
        time.sleep(0.5)
        while (after := next_header()).capture_time_ns < before.capture_time_ns + 3e9:
            pass
        # The camera's own account, over the gap: all that it captured was published here or is counted.
        assert after.captured - before.captured == after.device_sequence - before.device_sequence
        assert after.sequence - before.sequence < after.captured - before.captured - 60
        assert sum(after.dropped) - sum(before.dropped) == after.captured - before.captured - (after.sequence - before.sequence)
        rig.kill("there")
        wait_for_mirror(rig, "moving/depth", "waiting", 10)
        rig.start("there")
        again = wait_for("frames of the new daemon", lambda: (h := next_header()).device_sequence < after.device_sequence and h)
        # The reader goes on with the same stream.
        assert again.sequence > after.sequence and again.captured == again.sequence + sum(again.dropped)


def test_frames_come_small_where_the_way_is_slow(binary: str, tmp_path: Path) -> None:  # noqa: F811
    with two_computers(binary, tmp_path, "100mbit", mirror=STREAMS, more=MOVING) as rig:
        rig.start("here")
        rig.start("there")
        with read(rig):
            check_small(rig)


def check_small(rig: Rig) -> None:
    wait_for_mirror(rig, "moving/color", "live", coding="jpeg")
    wait_for_mirror(rig, "moving/depth", "live", coding="rank")
    depth = both(rig, "moving/depth", 20)
    check_headers(rig, depth)
    assert all(np.array_equal(here, there) for _, here, _, there in depth), "depth is what it was, bit for bit"
    color = both(rig, "moving/color", 20)
    check_headers(rig, color)
    off = [np.abs(here.astype(int) - there).mean() for _, here, _, there in color]
    assert max(off) < 4, "colour is nearly what it was"
    # It is late by less than two frames, where a busy computer does not hold it up; what waits in a queue all comes late.
    assert min(h.publish_time_ns - h.capture_time_ns for h, *_ in color) < 70e6
    assert mirrors(rig)["moving/color"]["skipped"] > 0


def test_depth_of_the_other_computer_is_refined_here_as_it_would_be_there(binary: str, tmp_path: Path) -> None:  # noqa: F811
    refine = '[link.hosts.refine]\nengine = "fill"\n'
    more = MOVING + '[camera.refine]\nengine = "fill"\n'
    with two_computers(binary, tmp_path, "10gbit", mirror=STREAMS, refine=refine, more=more) as rig:
        rig.start("here")
        assert rig.host()["refined"] == [{"camera": "moving", "refine": None}]
        assert "refined   moving: waits for its color and depth" in rig.ask("status", codes=(3,))
        rig.start("there")

        def state() -> Any:
            (refined,) = rig.host()["refined"]
            return refined["refine"] and refined["refine"]["state"] == "running" and refined["refine"]

        assert wait_for("the refiner", state)["engine"] == "fill"
        # The same code on other computers' images: all that differs is the way, and it carries them as they are.
        frames = both_raw(rig, "moving/depth_refined", 20, STREAMS)
        check_headers(rig, frames)
        for h, pixels, o, original in frames:
            assert (h.refiner, h.width, h.height) == (o.refiner, o.width, o.height)
            assert abs(h.source_color_capture_time_ns - (o.source_color_capture_time_ns - SHIFT_NS)) < 5_000_000
            assert np.array_equal(pixels, original)
        with depthrig.Stream("moving/depth", "mount", rig.runtime["here"], timeout=WAIT_S) as source, source.next(timeout=WAIT_S) as raw:
            assert (raw.array == 0).sum() > (frames[-1][1] == 0).sum(), "holes are filled"
        assert re.search(r"refined   moving: running, fill, .* Hz", rig.ask("status", codes=(0, 3)))
        # Another daemon there, and the stream goes on.
        with depthrig.Stream("moving/depth_refined", "mount", rig.runtime["here"], timeout=WAIT_S) as source:
            with source.next(timeout=WAIT_S) as frame:
                before = frame.header
            rig.kill("there")
            rig.wait_for_host("absent", 10)
            rig.start("there")
            again = wait_for("frames again", lambda: newer(source, before.capture_time_ns + 2_000_000_000))
            assert again.sequence > before.sequence and again.captured == again.sequence + sum(again.dropped)


def newer(source: Any, time_ns: int) -> Any:
    """The header of the next frame, if it is of after `time_ns`."""
    with source.next(timeout=WAIT_S) as frame:
        return frame.header if frame.header.capture_time_ns > time_ns else None


def test_too_little_shared_memory_is_named_and_harms_no_camera_here(rig: Rig) -> None:
    small = 'mount -t tmpfs -o size=60m small /dev/shm && exec "$@"'
    rig.start("here", ["unshare", "-m", "sh", "-c", small, "sh"])
    rig.start("there")
    mirror = wait_for_mirror(rig, "moving/color", "waiting")
    wait_for("the reason", lambda: "has no room for its" in (mirrors(rig)["moving/color"]["why"] or ""))
    time.sleep(2)
    assert mirror["frames"] == 0 and mirrors(rig)["moving/color"]["state"] == "waiting"
    assert rig.log("here").count("stream moving/color is not mirrored") == 1
    status = rig.status()
    assert status["shared_memory"]["free_bytes"] < 60 << 20
    assert [c["state"] for c in status["cameras"]] == ["streaming"] * 2, status["cameras"]
    assert all(not s["dropped"] for c in status["cameras"] for s in c["streams"])


def board_camera(name: str, x_m: float) -> str:
    """A camera before the board, which rests at one place as long as this test."""
    return f"""
[[camera]]
name = "{name}"
backend = "synthetic"
model = "d415"
serial = "{name}-1"
pose = {{ translation_m = [{x_m}, 0.0, 0.0] }}
stream = [{{ name = "color", width = 640, height = 480, rate_hz = 15.0 }}]
board = {{ file = "board.toml", motion = "wall", hold_s = 600.0 }}
"""


def test_a_view_of_the_board_has_cameras_of_both_computers(binary: str, tmp_path: Path) -> None:  # noqa: F811
    with two_computers(binary, tmp_path, mirror=["left/color"], more=board_camera("left", 0.05)) as rig:
        here = rig.rig_file("here")
        here.write_text(here.read_text() + board_camera("right", -0.05))
        rig.ask("calibrate", "board", "--paper", "a3", "--name", str(tmp_path / "board"))
        rig.start("here")
        rig.start("there")
        wait_for_mirror(rig, "left/color", "unread")
        views = tmp_path / "views"
        board = tmp_path / "board.toml"
        said = rig.ask("calibrate", "capture", "mount", "--board", str(board), "-o", str(views), "--views", "1", "--json")
        progress = json.loads(said.splitlines()[-1])["progress"]
        assert progress["pairs"] == [{"a": "left", "b": "right", "shared": 1, "missing": 2}]
        # Side by side before a board that faces them, they see it shifted by their distance, which the squares measure.
        sheet = tomllib.loads(board.read_text())
        corners = {c["name"]: np.array(c["at"]) * (640, 480) for c in progress["cameras"] if c["at"]}
        for name in corners:
            with depthrig.Stream(f"{name}/color", "mount", rig.runtime["here"], timeout=WAIT_S) as stream, stream.next(timeout=WAIT_S) as frame:
                k = frame.header.intrinsics
            corners[name] = (corners[name] - (k.cx, k.cy)) / (k.fx, k.fy)
        assert {name: len(at) for name, at in corners.items()} == {"left": 70, "right": 70}
        shift = corners["right"] - corners["left"]
        square = np.diff(corners["left"].reshape(7, 10, 2)[..., 0]).mean()
        assert np.abs(shift[:, 1]).max() < 1 / 600, "on the same rows"
        assert abs(shift[:, 0].mean() / square * sheet["square_mm"] - 100) < 1
        streams = {s["stream"] for s in json.loads(rig.ask("info", "--json", str(views)))["streams"]}
        assert {"left/color", "right/color"} <= streams
