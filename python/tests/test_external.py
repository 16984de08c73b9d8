"""Serving a camera from Python, against a daemon that the test plays itself: each message, each fault."""

from __future__ import annotations

import ctypes
import gc
import os
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import depthrig
from daemon import ANSWER, FakeDaemon, fake_daemon
from depthrig import ExternalCamera, ExternalClock, ExternalMode, ExternalReason, PixelFormat
from depthrig import _layout as layout
from depthrig._external_answer import read_answer
from depthrig._header import Intrinsics, Pose, pack_fields
from depthrig._layout import Distortion, ExternalFrameFlags, ExternalState, ExternalWant
from rig import WAIT_S

COLOR = ExternalMode("color", PixelFormat.RGB8, 8, 6, 30.0)
DEPTH = ExternalMode(
    "depth",
    PixelFormat.Z16,
    8,
    6,
    30.0,
    clock=ExternalClock.DEVICE,
    tick_ps=1_000_000,
    counter_bits=32,
    sequence_bits=32,
)
JPEG = ExternalMode("jpeg", PixelFormat.MJPEG, 8, 6, 30.0)
RED = np.zeros((6, 8, 3), np.uint8)
RED[..., 0] = 255


def serve(folder: Path, *modes: ExternalMode, **more: Any) -> ExternalCamera:
    return ExternalCamera(
        "front", modes or (COLOR, DEPTH), model="X1", serial="7", rig="mount", runtime_dir=folder, **more
    )


@pytest.fixture
def camera(folder: Path) -> Iterator[ExternalCamera]:
    with serve(folder) as camera:
        yield camera


@pytest.fixture
def daemon(folder: Path, camera: ExternalCamera) -> Iterator[FakeDaemon]:
    with fake_daemon(folder) as daemon:
        yield daemon


def test_every_byte_of_an_offer_and_its_modes(folder: Path) -> None:
    lens = Intrinsics(500.5, 501.5, 320.25, 240.75, tuple(float(i) for i in range(1, 9)), int(Distortion.RATIONAL), 0)
    pose = Pose((0.1, -0.2, 0.3), (0.5, -0.5, 0.5, -0.5))
    full = ExternalMode(
        "depth_2",
        PixelFormat.Z16,
        640,
        480,
        15.5,
        depth_unit_m=0.0001,
        intrinsics=lens,
        pose=pose,
        clock=ExternalClock.DEVICE_HEADER,
        tick_ps=83_333,
        counter_bits=40,
        sequence_bits=16,
        simulated=True,
    )
    more = {"firmware": "1.2.3", "port": "4-1.2", "calibration": "factory", "program": "probe"}
    with serve(folder, COLOR, full, **more), fake_daemon(folder) as daemon:
        offer = daemon.until(state=ExternalState.IDLE)
        color, mode = daemon.modes
    expected = {"magic": b"DREO", "version": 1, "size": 568, "session": 0, "reason": 0, "modes": 2, "pid": os.getpid()}
    expected |= {"model": "X1", "serial": "7", "text": "", **more}
    assert {k: offer[k] for k in expected} == expected
    assert offer["instance"] != 0
    assert 0 <= time.monotonic_ns() - offer["sent_ns"] < WAIT_S * 1e9
    assert not any(offer["reserved"])
    assert {n: mode[n] for n in mode if "." not in n and "reserved" not in n} == {
        "stream": "depth_2",
        "rate_hz": 15.5,
        "depth_unit_m": 0.0001,
        "tick_ps": 83_333,
        "format": 5,
        "width": 640,
        "height": 480,
        "clock": 2,
        "counter_bits": 40,
        "sequence_bits": 16,
        "flags": 1,
    }
    assert Intrinsics(*(mode[f"intrinsics.{n}"] for n in Intrinsics._fields)) == lens
    assert Pose(*(mode[f"pose.{n}"] for n in Pose._fields)) == pose
    assert (color["depth_unit_m"], color["intrinsics.fx"], color["pose.rotation_xyzw"]) == (0.0, 0.0, (0, 0, 0, 1))


def test_a_session_from_run_to_stop(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    first = daemon.until(state=ExternalState.IDLE)
    assert camera.wait(0.05) is None
    daemon.run(7, ("depth",), modes=b"\0\1")
    session = camera.wait(WAIT_S)
    assert session is not None
    assert (session.number, session.streams) == (7, {"depth": DEPTH})
    assert daemon.until(state=ExternalState.STARTING)["session"] == 7
    pixels = np.arange(48, dtype=np.uint16).reshape(6, 8)
    before = time.monotonic_ns()
    facts = {"exposure_ns": 5, "gain": 1.5, "temperature_c": 40.5, "triggered": True, "damaged": True}
    assert session.send("depth", pixels, device_time=123, device_sequence=9, **facts)
    assert daemon.until(state=ExternalState.RUNNING)["session"] == 7
    head, payload = daemon.frame("depth")
    assert payload == pixels.tobytes()
    assert before <= head.pop("arrival_time_ns") <= time.monotonic_ns()
    flags = ExternalFrameFlags.DAMAGED | ExternalFrameFlags.HARDWARE_TRIGGERED
    assert head == {
        "magic": b"DREF",
        "version": 1,
        "size": 128,
        "instance": first["instance"],
        "session": 7,
        "sequence": 1,
        "device_sequence": 9,
        "device_time": 123,
        "exposure_ns": 5,
        "gain": 1.5,
        "temperature_c": 40.5,
        "format": 5,
        "width": 8,
        "height": 6,
        "payload_len": 96,
        "flags": int(flags),
        "reserved_word": 0,
        "reserved": (0, 0, 0, 0),
    }
    with pytest.raises(ValueError, match=r"stream 'color' is not to run; to run are: depth"):
        session.send("color", RED)
    assert session.wanted
    daemon.say(ExternalWant.STOP, 7)
    _until(lambda: not session.wanted)
    session.close()
    assert daemon.until(state=ExternalState.IDLE)["session"] == 7
    with pytest.raises(ValueError, match="this session is over"):
        session.send("depth", pixels)


def test_a_time_that_did_not_come_is_said(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1, ("color", "depth"))
    with _session(camera) as session:
        session.send("depth", np.zeros((6, 8), np.uint16), arrival_ns=17)
        session.send("color", RED)
        depth, _ = daemon.frame("depth")
        assert (depth["flags"], depth["arrival_time_ns"]) == (int(ExternalFrameFlags.METADATA_LOST), 17)
        assert daemon.frame("color")[0]["flags"] == 0, "without a clock there is no time to lose"


def _session(camera: ExternalCamera) -> depthrig.ExternalSession:
    session = camera.wait(WAIT_S)
    assert session is not None
    return session


def _until(condition: Any) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_frames_are_copied_once_and_padding_is_left_out(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    padded = np.random.default_rng(1).integers(0, 255, (6, 40), np.uint8)
    view = padded[:, :24].reshape(6, 8, 3)
    with _session(camera) as session:
        session.send("color", view)
        assert daemon.frame("color")[1] == view.tobytes()
        session.send("color", view.tobytes())  # bytes of the right length
        assert daemon.frame("color")[1] == view.tobytes()
        lent = session.lend("color")
        assert lent is not None
        lent.array[...] = RED
        assert lent.send()
        assert daemon.frame("color")[1] == RED.tobytes()
        with pytest.raises(ValueError, match="sent already"):
            lent.send()


def test_an_array_outlives_its_session(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    with _session(camera) as session:
        lent = session.lend("color")
        assert lent is not None
        array = lent.array
        lent.send()
        kept = session.lend("color")
        assert kept is not None
    del lent, session
    gc.collect()
    array[...] = 3  # would end the process if its memory were gone
    kept.array[...] = 4
    assert kept.send() is False, "the session is over"


def test_jpegs_have_their_own_lengths(folder: Path) -> None:
    with serve(folder, JPEG) as camera, fake_daemon(folder) as daemon:
        daemon.run(1, ("jpeg",))
        with _session(camera) as session:
            session.send("jpeg", b"\xff\xd8 an image")
            head, payload = daemon.frame("jpeg")
            assert (payload, head["payload_len"]) == (b"\xff\xd8 an image", 11)
            for wrong in (b"", bytes(97), np.zeros((2, 2), np.uint8)):
                with pytest.raises(ValueError, match="a JPEG of stream 'jpeg' is 1 to 96 bytes"):
                    session.send("jpeg", wrong)
        assert (daemon.silent("jpeg"), session.streams["jpeg"].shape) == (True, (96,))


@pytest.mark.parametrize(
    "wrong", [RED[:5], RED[..., :2], RED.astype(np.uint16), bytes(143), np.zeros((6, 8), np.uint8), RED.T]
)
def test_pixels_that_do_not_fit_the_mode_are_refused_here(
    camera: ExternalCamera, daemon: FakeDaemon, wrong: Any
) -> None:
    daemon.run(1)
    with _session(camera) as session:
        session.start()
        with pytest.raises(ValueError, match=r"stream 'color' \(color 8x6 rgb8 30 Hz\) is \(6, 8, 3\) uint8, not"):
            session.send("color", wrong)
        session.send("color", RED)
        assert daemon.frame("color")[0]["sequence"] == 1, "what was refused was no frame"


def test_frames_that_nobody_reads_are_replaced_and_counted(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    with _session(camera) as session:
        for i in range(1, 11):
            session.send("color", np.full_like(RED, i))
        session.skip("color", 5)
        held = [session.lend("color") for _ in range(6)]
        assert held.count(None) == 3, "three may be written at a time"
        assert session.no_slot["color"] == 3
        del held
        session.send("color", RED)
        got = [daemon.frame("color")[0]["sequence"] for _ in range(4)]
    assert got == [8, 9, 10, 22], "every frame that was had is counted"


def test_a_silent_daemon_ends_the_session_and_a_new_one_begins(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    session = _session(camera)
    session.send("color", RED)
    daemon.beating = False
    _until(lambda: not session.wanted)
    # A busy computer may not have heard it for some time before.
    assert camera._answer is not None
    assert time.monotonic() - camera._answer.heard > layout.EXTERNAL_SILENCE_S, "a pause is no end"
    session.close()
    assert camera.wait(0.3) is None
    daemon.beating = True
    assert camera.wait(0.5) is None, "the same session again is none"
    daemon.run(2)
    assert _session(camera).number == 2


def test_another_session_ends_the_one_before(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    session = _session(camera)
    daemon.say(ExternalWant.RUN, 2)
    _until(lambda: not session.wanted)
    with pytest.raises(ValueError, match="the session before is not over yet"):
        camera.wait(0)
    session.close()
    assert _session(camera).number == 2


@pytest.mark.parametrize(
    "change",
    [{"instance": 5}, {"magic": b"NOPE"}, {"sent_ns": 1}],
    ids=lambda c: next(iter(c)),
)
def test_an_answer_that_is_for_another_is_ignored(camera: ExternalCamera, daemon: FakeDaemon, change: dict[str, Any]) -> None:
    daemon.run(1, change=change)
    assert camera.wait(0.5) is None
    daemon.run(1)
    assert _session(camera).number == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"want": 99}, "it wants 99, which this package does not know"),
        ({"modes": 3}, "it answers for 3 modes in 2 bytes, and this camera has 2"),
    ],
    ids=["want", "modes"],
)
def test_an_answer_that_cannot_be_is_an_error(
    camera: ExternalCamera, daemon: FakeDaemon, change: dict[str, Any], text: str
) -> None:
    daemon.run(1, change=change)
    with pytest.raises(depthrig.CameraRefused, match=text):
        camera.wait(WAIT_S)
    daemon.run(1)
    _until(lambda: camera._answer is not None and camera._answer.want is ExternalWant.RUN)
    assert _session(camera).number == 1, "a good one is taken all the same"


def test_whatever_an_answer_holds_it_is_read_or_refused() -> None:
    head = pack_fields(
        layout.EXTERNAL_ANSWER_FIELDS,
        layout.EXTERNAL_ANSWER_SIZE,
        {**ANSWER, "instance": 7, "session": 3, "want": 1, "modes": 2, "sent_ns": time.monotonic_ns()},
    )
    good = read_answer((head, b"\1\0"), 7, 2)
    assert good is not None
    assert (good.session, good.want) == (3, ExternalWant.RUN)
    random = np.random.default_rng(6)
    seen = set()
    for _ in range(5000):
        bad = bytearray(head)
        for at in random.integers(0, len(bad), random.integers(1, 5)):
            bad[at] = random.choice([0, 1, 0x7F, 0x80, 0xFF, 0x1B])
        answer = read_answer((bytes(bad), bytes(random.integers(0, 4, random.integers(0, 5)).astype(np.uint8))), 7, 2)
        if answer is not None:
            assert all(c.isprintable() for c in answer.text)
            seen.add((answer.want, answer.reason_name))
    assert {(ExternalWant.REFUSED, "version"), (ExternalWant.REFUSED, "invalid")} <= seen
    assert any(want is ExternalWant.RUN for want, _ in seen)


def test_files_at_their_end_lose_nothing(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    session = _session(camera)
    session.start(lossless=True)
    sender = threading.Thread(target=lambda: [session.send("color", RED + i) for i in range(20)])
    sender.start()
    time.sleep(0.3)
    assert sender.is_alive(), "it waits, because no more than 4 may be unread"
    heads = [daemon.frame("color")[0] for _ in range(20)]
    assert [h["sequence"] for h in heads] == list(range(1, 21)), "none was replaced and none was counted as lost"
    sender.join(WAIT_S)
    assert session.no_slot["color"] == 0
    assert not session.finish("all played", timeout=0.3), "the daemon has not said that it has them"
    daemon.until(state=ExternalState.REFUSED, reason=ExternalReason.FINISHED, session=1, text="all played")
    daemon.run(2)
    session = _session(camera)
    stop = threading.Timer(0.2, lambda: daemon.say(ExternalWant.STOP, 2))
    stop.start()
    assert session.finish("all played", timeout=WAIT_S)
    assert not session.wanted
    stop.join()


def test_a_refusal_is_an_error_with_the_daemons_words(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.say(ExternalWant.REFUSED, 0, reason=int(ExternalReason.INVALID), text="stream color: its rate is no number")
    with pytest.raises(
        depthrig.CameraRefused, match=r"rig 'mount' refuses camera 'front': stream color: its rate is no number"
    ):
        camera.wait(WAIT_S)


@pytest.mark.parametrize("change", [{"version": 2}, {"size": 384}], ids=["version", "size"])
def test_a_daemon_of_another_version_is_an_error(camera: ExternalCamera, daemon: FakeDaemon, change: Any) -> None:
    daemon.run(1, change=change)
    with pytest.raises(depthrig.CameraRefused, match=r"it speaks version \d of the hand-shake, this package version 1"):
        camera.wait(WAIT_S)


def test_an_answer_to_an_older_session_changes_nothing(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(5)
    assert _session(camera).number == 5
    daemon.say(ExternalWant.STOP, 4)
    time.sleep(0.4)
    assert camera._answer is not None
    assert camera._answer.session == 5


def test_a_camera_that_is_not_there_is_offered_all_the_same(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    camera.unavailable("unplugged")
    offer = daemon.until(state=ExternalState.REFUSED)
    assert (offer["session"], offer["reason"], offer["text"]) == (0, ExternalReason.NOT_FOUND, "unplugged")
    camera.available()
    daemon.until(state=ExternalState.IDLE, session=0, reason=0, text="")
    with pytest.raises(ValueError, match="what model is it"):
        ExternalCamera("other", [COLOR], model="", serial="7", rig="mount")


def test_a_refused_session_may_be_followed_by_another(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(4)
    session = _session(camera)
    daemon.say(ExternalWant.REFUSED, 4, text="frames of another size")
    _until(lambda: not session.wanted)
    session.close()
    assert camera.wait(0.3) is None
    daemon.run(5)
    assert _session(camera).number == 5


def test_the_camera_can_refuse(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    _session(camera).refuse("no such lens — sorry\n" + "é" * 300, ExternalReason.NOT_FOUND)
    offer = daemon.until(state=ExternalState.REFUSED)
    assert (offer["session"], offer["reason"]) == (1, ExternalReason.NOT_FOUND)
    assert offer["text"] == ("no such lens — sorry " + "é" * 300)[: len(offer["text"])], (
        "cut, without control characters"
    )
    assert 250 < len(offer["text"].encode()) < 256


def test_how_a_process_ends_is_said(folder: Path) -> None:
    def last(end: Any) -> tuple[int, int, str]:
        camera = serve(folder)
        with fake_daemon(folder) as daemon:
            daemon.until(state=ExternalState.IDLE)
            end(camera)
            offer = daemon.until(state=ExternalState.ENDED)
        return offer["session"], offer["reason"], offer["text"]

    def fail(camera: ExternalCamera) -> None:
        with pytest.raises(KeyError), camera:
            raise KeyError("lens")

    assert last(lambda camera: camera.close()) == (0, 0, "")
    done = (ExternalReason.FINISHED, "the files are at their end")
    assert last(lambda camera: camera.close(*done)) == (0, *done)
    assert last(fail) == (0, ExternalReason.DEVICE, "KeyError: 'lens'")


def test_without_a_rig_it_says_how_to_come_first(folder: Path) -> None:
    with pytest.raises(depthrig.RigNotRunning, match=r"no rig is running in .*, or name the rig with rig=…"):
        ExternalCamera("front", [COLOR], model="X1", serial="7", runtime_dir=folder)


def test_stop_ends_the_sessions_from_any_thread(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.run(1)
    seen = []
    for session in camera.sessions():
        seen.append(session.number)
        threading.Timer(0.1, camera.stop).start()
        while session.wanted:
            time.sleep(0.01)
    assert seen == [1]
    assert daemon.until(state=ExternalState.IDLE)["session"] == 1
    assert camera.stopped


def test_a_camera_is_served_by_one_process(camera: ExternalCamera, folder: Path) -> None:
    with pytest.raises(depthrig.CameraServed, match=rf"is served already, by process {os.getpid()} \(.*\); end that"):
        serve(folder)
    camera.close()
    serve(folder).close()


def test_the_daemon_tells_a_program_its_place(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEPTHRIG_RUNTIME_DIR", str(folder))
    monkeypatch.setenv("DEPTHRIG_RIG", "mount")
    monkeypatch.setenv("DEPTHRIG_CAMERA", "left_2")
    with ExternalCamera(None, [COLOR], model="X", serial="") as camera:
        assert (camera.name, camera.rig) == ("left_2", "mount")
    monkeypatch.delenv("DEPTHRIG_CAMERA")
    with pytest.raises(ValueError, match="which camera of the rig"):
        ExternalCamera(None, [COLOR], model="X", serial="")


def test_a_killed_process_makes_room_for_the_next(folder: Path) -> None:
    program = textwrap.dedent(
        f"""
        import depthrig, time
        mode = depthrig.ExternalMode("color", depthrig.PixelFormat.RGB8, 8, 6, 30.0)
        place = dict(rig="mount", runtime_dir={str(folder)!r})
        camera = depthrig.ExternalCamera("front", [mode], model="X", serial="7", **place)
        print("ready", flush=True)
        time.sleep({WAIT_S})
        """
    )
    with fake_daemon(folder) as daemon:
        instances = set()
        for _ in range(6):  # more than the channels have room for
            process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
            assert process.stdout is not None
            process.stdout.readline()
            daemon.until(pid=process.pid)
            assert daemon.offer is not None
            instances.add(daemon.offer["instance"])
            process.kill()
            process.wait()
            process.stdout.close()
        assert len(instances) == 6
        with serve(folder):
            daemon.until(pid=os.getpid())


def test_heartbeats_come_while_the_program_is_busy(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.until(state=ExternalState.IDLE)
    before = daemon.offers
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        sum(range(10_000))
    for _ in range(5):
        daemon.read()
    # Four messages wait unread, so the number identifies the newest.
    assert daemon.offer is not None
    assert daemon.offers > before
    assert daemon.offer["number"] >= 4


def test_a_forked_child_may_not_serve(camera: ExternalCamera, daemon: FakeDaemon) -> None:
    daemon.until(state=ExternalState.IDLE)
    pid = os.fork()
    if pid == 0:
        try:
            camera.wait(0)
        except depthrig.BusError:
            os._exit(42)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 42
    daemon.run(1)
    assert _session(camera).number == 1, "the parent is as it was"


def test_channels_of_another_version_are_refused(folder: Path) -> None:
    import iceoryx2 as iox2

    from depthrig._bus import Bus

    bus = Bus.at(str(folder))
    name = iox2.ServiceName.new(f"{layout.EXTERNAL_PREFIX}/mount/front/offer")
    _service = bus.node.service_builder(name).publish_subscribe(iox2.Slice[ctypes.c_uint8]).create()
    with pytest.raises(depthrig.VersionMismatch, match="was made by another version of depthrig or iceoryx2"):
        serve(folder)
    # And the camera can be served again by whoever has the right version.
    assert depthrig._external._lock(str(folder), "mount", "front", "x") > 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"stream": "Color"}, "cannot be the name of a stream"),
        ({"width": 0}, "invalid size 0x6"),
        ({"height": 16385}, "invalid size 8x16385"),
        ({"rate_hz": 0.0}, "invalid rate"),
        ({"rate_hz": float("nan")}, "invalid rate"),
        ({"rate_hz": 1001.0}, "invalid rate"),
        ({"format": PixelFormat.YUYV, "width": 7}, "an even number of columns"),
        ({"format": PixelFormat.NV12, "height": 7}, "an even number of rows"),
        ({"format": PixelFormat.DEPTH_F32, "width": 16384, "height": 16384}, "bytes is too large"),
        ({"format": PixelFormat.Z16, "depth_unit_m": float("inf")}, "invalid depth unit"),
        ({"format": PixelFormat.Z16, "depth_unit_m": -0.001}, "invalid depth unit"),
        ({"clock": ExternalClock.HOST, "tick_ps": 1_000_000}, "the host's clock has ticks of 1000 ps"),
        ({"format": 99}, "99 is not a valid PixelFormat"),
        ({"format": PixelFormat.MOTION, "height": 1}, "IMU samples of another process's camera are not supported yet"),
    ],
)
def test_a_mode_that_cannot_be_is_refused_where_it_is_made(change: dict[str, Any], text: str) -> None:
    values: dict[str, Any] = {"stream": "color", "format": PixelFormat.RGB8, "width": 8, "height": 6, "rate_hz": 30.0}
    with pytest.raises(ValueError, match=text):
        ExternalMode(**{**values, **change})


def test_a_camera_without_modes_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="a camera has 1 to 64 modes"):
        ExternalCamera("front", [], model="X", serial="7", rig="mount", runtime_dir=folder)
    with pytest.raises(ValueError, match="not 17 of 17"):
        serve(folder, *(ExternalMode(f"s{i}", PixelFormat.MONO8, 8, 6, 30.0) for i in range(17)))
    serve(folder).close()
