"""The OAK bridge with the vendor's SDK: host-only pipelines in place of a camera, real names where nodes need one.

Runs where `depthai` is installed (`tools/python.sh oak`), and says so where it is not. No camera was ever attached.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

import depthrig
from daemon import FakeDaemon, fake_daemon
from depthrig import ExternalClock, ExternalReason, PixelFormat
from depthrig._layout import Distortion, ExternalState
from rig import ROOT, WAIT_S

dai = pytest.importorskip("depthai", reason="the SDK is not installed; `tools/python.sh oak` puts it into .venv-oak")
from PIL import Image  # noqa: E402

from depthrig.oak import __main__ as program  # noqa: E402
from depthrig.oak import _bridge, _device, _lens, _replay  # noqa: E402
from depthrig.oak._errors import Exit, OakError  # noqa: E402
from depthrig.oak._lossless import LosslessQueue  # noqa: E402

SOCKET = dai.CameraBoardSocket
WIDTH, HEIGHT, IMAGES = 64, 48, 5
K = [[50.5, 0.0, 31.5], [0.0, 51.5, 23.5], [0.0, 0.0, 1.0]]


def calibration(coefficients: list[float] | None = None) -> Any:
    """As a camera has it in its EEPROM."""
    handler = dai.CalibrationHandler()
    handler.setBoardInfo("OAK-D", "R1")
    handler.setProductName("OAK-D-TEST")
    handler.setCameraType(SOCKET.CAM_A, dai.CameraModel.Perspective)
    handler.setCameraIntrinsics(SOCKET.CAM_A, K, dai.Size2f(WIDTH, HEIGHT))
    handler.setDistortionCoefficients(SOCKET.CAM_A, coefficients or [0.0] * 14)
    return handler


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Five pairs, each pixel of which encodes its position and its image."""
    folder = tmp_path / "oak_images"
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(IMAGES):
        color = np.stack([columns + i, rows, np.full_like(rows, 50 * i)], axis=-1).astype(np.uint8)
        Image.fromarray(color).save(folder / "color" / f"{i:03}.png")
        Image.fromarray((columns * 700 + rows + i).astype(np.uint16)).save(folder / "depth" / f"{i:03}.png")
    assert calibration([0.1] * 8).eepromToJsonFile(folder / "calibration.json")
    return folder


def image(folder: Path, stream: str, number: int) -> np.ndarray:
    return np.asarray(Image.open(folder / stream / f"{number % IMAGES:03}.png"))


@contextmanager
def bridge(folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "depthrig.oak", "--camera", "oak", "--rig", "mount", *options]
    env = {**os.environ, "DEPTHRIG_RUNTIME_DIR": str(folder)}
    process = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def pixels(head: dict[str, Any], payload: bytes) -> np.ndarray:
    if head["format"] == PixelFormat.Z16:
        return np.frombuffer(payload, np.uint16).reshape(head["height"], head["width"])
    assert head["format"] == PixelFormat.BGR8
    return np.frombuffer(payload, np.uint8).reshape(head["height"], head["width"], 3)[..., ::-1]


def check(daemon: FakeDaemon, folder: Path, stream: str, frames: int, rate_hz: float) -> list[int]:
    """Take frames of a stream: each is the image of its number, at the time of its number; returns the numbers."""
    numbers = []
    for _ in range(frames):
        head, payload = daemon.frame(stream)
        number = head["device_sequence"]
        np.testing.assert_array_equal(pixels(head, payload), image(folder, stream, number))
        assert head["device_time"] == pytest.approx(100e6 + number * 1e6 / rate_hz, abs=1)
        assert 0 <= time.monotonic_ns() - head["arrival_time_ns"] < WAIT_S * 1e9
        numbers.append(number)
    assert numbers == sorted(set(numbers))
    return numbers


def test_images_are_served_as_a_camera(folder: Path, images: Path) -> None:
    with (
        bridge(folder, "--replay", str(images), "--fps", "50") as process,
        fake_daemon(folder, camera="oak") as daemon,
    ):
        offer = daemon.until(state=ExternalState.IDLE)
        reported = {k: offer[k] for k in ("model", "serial", "calibration", "port")}
        name = images.name
        assert reported == {"model": "OAK-D-TEST", "serial": name, "calibration": "file calibration.json", "port": name}
        assert offer["firmware"] == f"depthai {dai.__version__}"
        color, depth = sorted(daemon.modes, key=lambda m: m["stream"])
        for mode, kind in ((color, PixelFormat.BGR8), (depth, PixelFormat.Z16)):
            assert (mode["format"], mode["width"], mode["height"], mode["rate_hz"]) == (kind, WIDTH, HEIGHT, 50.0)
            assert (mode["clock"], mode["tick_ps"]) == (ExternalClock.DEVICE_HEADER, 1_000_000)
            lens = [mode[f"intrinsics.{n}"] for n in ("fx", "fy", "cx", "cy")]
            assert lens == pytest.approx([50.5, 51.5, 31.5, 23.5])
            assert mode["intrinsics.model"] == Distortion.NONE, "what is aligned is undistorted"
        assert (color["depth_unit_m"], depth["depth_unit_m"]) == (0.0, 0.001)
        daemon.run(1, ("color", "depth"))
        seen = [check(daemon, images, stream, 12, 50.0) for stream in ("color", "depth")]
        assert all(numbers[-1] >= 11 for numbers in seen), "they come round again, and the numbers go on"
        daemon.say(0, 1)
        assert daemon.until(state=ExternalState.IDLE)["session"] == 1
        daemon.run(2, ("color", "depth"))
        again = check(daemon, images, "color", 3, 50.0)
        assert again[0] > seen[0][-1], "a session begins with what is new"
        process.send_signal(signal.SIGTERM)
        assert daemon.until(state=ExternalState.ENDED)["reason"] == 0
        assert process.wait(WAIT_S) == Exit.DONE


def play_once(daemon: FakeDaemon, folder: Path, rate_hz: float) -> None:
    """Be the daemon of files that are played once: each frame comes, from the first one to the last."""
    daemon.until(state=ExternalState.IDLE)
    time.sleep(0.3)  # unwanted frames are not lost
    daemon.run(1, ("color", "depth"))
    time.sleep(0.3)  # nor frames that are not read at once
    for number in range(IMAGES):  # in turn, as a stream that is not read holds up the other
        for stream in ("color", "depth"):
            assert check(daemon, folder, stream, 1, rate_hz) == [number]
    daemon.until(state=ExternalState.REFUSED, reason=ExternalReason.FINISHED, session=1)
    daemon.say(0, 1)
    daemon.until(state=ExternalState.ENDED, reason=ExternalReason.FINISHED, text="the files are at their end")


@pytest.mark.parametrize("kind", ["images", "recordings"])
def test_files_that_are_played_once_come_to_the_last_frame(folder: Path, images: Path, tmp_path: Path, kind: str) -> None:
    played = images
    if kind == "recordings":
        played = tmp_path / "kept"
        with bridge(folder, "--replay", str(images), "--once", "--fps", "50", "--record", str(played)) as process:
            with fake_daemon(folder, camera="oak") as daemon:
                play_once(daemon, images, 50.0)
            assert process.wait(WAIT_S) == Exit.DONE
        assert _replay._messages(played / "depth.mcap") == IMAGES
    for _ in range(3):  # the end of two files is a race inside of the SDK
        with bridge(folder, "--replay", str(played), "--once", "--fps", "50") as process:
            with fake_daemon(folder, camera="oak") as daemon:
                daemon.until(pid=process.pid)
                play_once(daemon, images, 50.0)
            assert process.wait(WAIT_S) == Exit.DONE


def test_what_a_daemon_did_not_take_is_no_success(caplog: pytest.LogCaptureFixture) -> None:
    done = SimpleNamespace(missing={}, confirmed=True)
    assert program._account(done) is Exit.DONE
    assert program._account(SimpleNamespace(missing={}, confirmed=False)) is Exit.UNDELIVERED
    assert "did not confirm the last ones" in caplog.text
    assert program._account(SimpleNamespace(missing={"depth": 2}, confirmed=True)) is Exit.UNDELIVERED
    assert "that the daemon did not get: 2 depth" in caplog.text


def test_a_recording_that_was_cut_is_not_played_once(folder: Path, images: Path) -> None:
    shutil.copy(images / "calibration.json", images / "color.mcap")
    with bridge(folder, "--replay", str(images), "--once") as process:
        _, errors = process.communicate(timeout=WAIT_S)
    assert process.returncode == Exit.USAGE
    assert "color.mcap has no summary" in errors


def test_a_lossless_queue_lets_no_stream_run_ahead() -> None:
    queue = LosslessQueue(["color", "depth"])
    took: list[str] = []

    def feed(stream: str, frames: int) -> None:
        for i in range(frames):
            queue.put(stream, f"{stream}{i}")

    threads = [threading.Thread(target=feed, args=(s, 3), daemon=True) for s in ("color", "depth")]
    threads[0].start()
    time.sleep(0.1)
    assert [f for _, f in queue.take(1.0)] == ["color0"]
    assert queue.take(0.1) == [], "it waits for depth0"
    threads[1].start()
    while len(took) < 5:
        took += [f for _, f in queue.take(1.0)]
    assert sorted(took) == ["color1", "color2", "depth0", "depth1", "depth2"]
    for thread in threads:
        thread.join(WAIT_S)
    assert queue.came == {"color": 3, "depth": 3}
    last = threading.Thread(target=feed, args=("color", 2), daemon=True)
    last.start()
    queue.close()
    last.join(WAIT_S)
    assert not last.is_alive(), "its end lets the SDK go"


def test_what_was_recorded_is_replayed_as_it_was(folder: Path, images: Path, tmp_path: Path) -> None:
    """The SDK's own writer and player: numbers, times, pixels and calibration come back."""
    kept = tmp_path / "kept"
    with bridge(folder, "--replay", str(images), "--once", "--fps", "20", "--record", str(kept)) as process:
        with fake_daemon(folder, camera="oak") as daemon:
            play_once(daemon, images, 20.0)
        assert process.wait(WAIT_S) == Exit.DONE
    assert sorted(p.name for p in kept.iterdir()) == ["calibration.json", "color.mcap", "depth.mcap"]
    options = ("--replay", str(kept), "--serial", "184430", "--streams", "depth", "color")
    with bridge(folder, *options) as process, fake_daemon(folder, camera="oak") as daemon:
        offer = daemon.until(pid=process.pid, state=ExternalState.IDLE)
        assert (offer["serial"], offer["model"]) == ("184430", "OAK-D-TEST")
        assert daemon.modes[0]["intrinsics.fx"] == pytest.approx(50.5)
        daemon.run(1, ("color", "depth"))
        for stream in ("color", "depth"):
            numbers = []
            for _ in range(12):
                head, payload = daemon.frame(stream)
                # The SDK goes on counting, and keeping time, when it begins anew.
                numbers.append(head["device_sequence"])
                np.testing.assert_array_equal(pixels(head, payload), image(images, stream, numbers[-1]))
                assert head["device_time"] == pytest.approx(100e6 + numbers[-1] * 50_000, abs=IMAGES)
            assert numbers == sorted(set(numbers))
            assert numbers[-1] > 2 * IMAGES


def test_a_recording_is_never_written_over(folder: Path, images: Path) -> None:
    with bridge(folder, "--replay", str(images), "--record", str(images)) as process:
        _, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == Exit.USAGE
        assert "is not empty; a recording is written into a folder of its own" in errors


def test_a_killed_bridge_makes_room_for_the_next(folder: Path, images: Path) -> None:
    with fake_daemon(folder, camera="oak") as daemon:
        for session in (1, 2):
            with bridge(folder, "--replay", str(images), "--fps", "50") as process:
                daemon.until(pid=process.pid, state=ExternalState.IDLE)
                daemon.run(session, ("color", "depth"))
                check(daemon, images, "color", 3, 50.0)
                process.kill()
                process.wait()


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda f: shutil.rmtree(f), "is not a folder"),
        (lambda f: [shutil.rmtree(f / n) for n in ("color", "depth")], "has neither recordings"),
        (lambda f: (f / "depth" / "000.png").unlink(), "its images do not form pairs, there are 5 color, 4 depth"),
        (lambda f: (f / "color" / "001.png").write_bytes(b"no image"), "color/001.png cannot be read"),
        (lambda f: Image.new("RGB", (64, 48)).save(f / "depth" / "002.png"), "002.png is not a depth image: it needs"),
        (lambda f: (f / "calibration.json").write_text("{"), "calibration.json is not a calibration of an OAK camera"),
        (lambda f: (f / "color.mcap").write_bytes(b"no recording"), "color"),
    ],
    ids=["no folder", "empty", "no pairs", "no image", "no depth", "calibration", "recording"],
)
def test_files_that_cannot_be_played_are_named(folder: Path, images: Path, spoil: Any, text: str) -> None:
    spoil(images)
    with bridge(folder, "--replay", str(images)) as process:
        _, errors = process.communicate(timeout=WAIT_S)
    assert process.returncode in (Exit.USAGE, Exit.LOST), errors
    assert text in errors
    assert "Traceback" not in errors


def frame(kind: Any, array: np.ndarray, **more: Any) -> Any:
    message = dai.ImgFrame()
    message.setCvFrame(array, kind)
    for name, value in more.items():
        getattr(message, f"set{name}")(value)
    return message


def test_pixels_are_seen_where_they_are() -> None:
    color = np.random.default_rng(1).integers(0, 255, (6, 8, 3), np.uint8)
    shown = _bridge.pixels(frame(dai.ImgFrame.Type.BGR888i, color))
    np.testing.assert_array_equal(shown, color)
    assert not shown.flags.owndata
    depth = np.random.default_rng(2).integers(0, 65535, (6, 8), np.uint16)
    shown = _bridge.pixels(frame(dai.ImgFrame.Type.RAW16, depth))
    np.testing.assert_array_equal(shown, depth)
    assert shown.dtype == np.uint16
    assert not shown.flags.owndata


def test_padding_of_rows_is_left_out() -> None:
    data = np.random.default_rng(3).integers(0, 255, (6, 40), np.uint8)
    padded = dai.ImgFrame()
    padded.setType(dai.ImgFrame.Type.BGR888i).setSize(8, 6).setStride(40)
    padded.setData(data.reshape(-1))
    np.testing.assert_array_equal(_bridge.pixels(padded), data[:, :24].reshape(6, 8, 3))
    padded.setData(data.reshape(-1)[: 5 * 40 + 24])  # and the last row may have none
    np.testing.assert_array_equal(_bridge.pixels(padded), data[:, :24].reshape(6, 8, 3))
    padded.setData(data.reshape(-1)[: 5 * 40 + 23])
    with pytest.raises(OakError, match="rows of 40 bytes has only 223 bytes"):
        _bridge.pixels(padded)


def test_nv12_of_the_sdk_is_nv12() -> None:
    data = np.random.default_rng(4).integers(0, 255, 8 * 9, np.uint8)
    message = dai.ImgFrame()
    message.setType(dai.ImgFrame.Type.NV12).setSize(8, 6)
    message.setData(data)
    np.testing.assert_array_equal(_bridge.pixels(message), data.reshape(9, 8))


def test_a_stream_of_another_type_is_refused() -> None:
    source = mock.Mock(calibration=None, rate_hz=30.0)
    for stream, kind, shape in (("color", "RAW16", (6, 8)), ("depth", "GRAY8", (6, 8)), ("color", "YUV420p", (9, 8))):
        message = dai.ImgFrame()
        message.setType(getattr(dai.ImgFrame.Type, kind)).setSize(8, 6)
        with pytest.raises(OakError, match=f"stream {stream} gives frames of type {kind}"):
            _bridge.mode_of(stream, message, source, True)
        assert shape


def test_the_frames_own_lens_comes_before_the_calibrations() -> None:
    array = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    source = SimpleNamespace(calibration=calibration([0.1] * 8), rate_hz=30.0, sockets={"color": SOCKET.CAM_A})
    plain = frame(dai.ImgFrame.Type.BGR888i, array)
    assert _lens.of_frame(plain) is None
    assert _bridge.mode_of("color", plain, source, True).intrinsics == _lens.intrinsics(_f32(K))
    raw = _bridge.mode_of("color", plain, source, False).intrinsics
    assert raw is not None
    assert (raw.model, raw.coeffs) == (Distortion.RATIONAL, pytest.approx([0.1] * 8))
    carried = dai.ImgTransformation(WIDTH, HEIGHT, [[60.0, 0, 30], [0, 61.0, 20], [0, 0, 1]])
    own = _bridge.mode_of("color", frame(dai.ImgFrame.Type.BGR888i, array, Transformation=carried), source, True)
    assert own.intrinsics == _lens.intrinsics([[60.0, 0, 30], [0, 61.0, 20], [0, 0, 1]])
    unknown = SimpleNamespace(calibration=None, rate_hz=30.0, sockets={})
    assert not _bridge.mode_of("color", plain, unknown, True).intrinsics.is_known


def _f32(matrix: list[list[float]]) -> list[list[float]]:
    return [[float(np.float32(v)) for v in row] for row in matrix]


# Code that needs a camera, tested without one: the SDK's real names and values around fake nodes.


def info(serial: str, name: str = "4.1.2", state: str = "X_LINK_UNBOOTED", protocol: str = "X_LINK_USB_VSC") -> Any:
    return dai.DeviceInfo(
        name,
        serial,
        getattr(dai.XLinkDeviceState, state),
        getattr(dai.XLinkProtocol, protocol),
        dai.XLinkPlatform.X_LINK_MYRIAD_X,
        dai.XLinkError_t.X_LINK_SUCCESS,
    )


def attached(monkeypatch: pytest.MonkeyPatch, free: list[Any], busy: list[Any]) -> None:
    device = SimpleNamespace(getAllAvailableDevices=lambda: free, getAllConnectedDevices=lambda: free + busy)
    monkeypatch.setattr(_device, "dai", SimpleNamespace(**{**vars(dai), "Device": device}))


def test_a_camera_is_chosen_by_its_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = info("1844301041"), info("1944301099", "3.2")
    attached(monkeypatch, [one, other], [info("777", "2.1", "X_LINK_BOOTED")])
    assert _device.find("1944301099", 0).getDeviceId() == "1944301099"
    with pytest.raises(OakError, match=r"2 OAK cameras are attached: 1844301041 \(4.1.2, unbooted\), .*--serial") as e:
        _device.find(None, 0)
    assert e.value.code is Exit.USAGE
    with pytest.raises(OakError, match="no OAK camera with the serial number 777 is free: 777 .* is in use") as e:
        _device.find("777", 0)
    assert e.value.code is Exit.NO_CAMERA
    with pytest.raises(OakError, match="serial number 5 was found, attached are: 1844301041 .*, 1944301099"):
        _device.find("5", 0)
    assert _device.listing() == [
        "1844301041  4-1.2  unbooted  free",
        "1944301099  3-2  unbooted  free",
        "777  2-1  booted  in use",
    ]
    attached(monkeypatch, [one], [])
    assert _device.find(None, 0).getDeviceId() == "1844301041"
    attached(monkeypatch, [], [])
    with pytest.raises(OakError, match="no OAK camera was found, none is attached; .*udev rule"):
        _device.find(None, 0)


def test_a_camera_that_is_still_starting_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter([[], [], [info("1")]])
    device = SimpleNamespace(getAllAvailableDevices=lambda: next(answers), getAllConnectedDevices=list)
    monkeypatch.setattr(_device, "dai", SimpleNamespace(**{**vars(dai), "Device": device}))
    assert _device.find("1", WAIT_S).getDeviceId() == "1"


def test_a_port_is_written_as_the_kernel_does() -> None:
    assert _device.port(info("1", "4.1.2")) == "4-1.2"
    assert _device.port(info("1", "192.168.1.44", protocol="X_LINK_TCP_IP")) == "192.168.1.44"


class FakeOak:
    """A camera whose methods and nodes have the SDK's names, and nothing behind them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, sockets: str = "ABC", platform: str = "RVC2") -> None:
        self.device = mock.create_autospec(dai.Device, instance=True)
        self.device.getConnectedCameras.return_value = [getattr(SOCKET, f"CAM_{s}") for s in sockets]
        self.device.getPlatform.return_value = getattr(dai.Platform, platform)
        self.device.getUsbSpeed.return_value = dai.UsbSpeed.SUPER
        self.device.getProductName.return_value = "OAK-D-PRO"
        self.device.getDeviceId.return_value = "1844301041"
        self.device.isCalibrationAvailable.return_value = True
        self.device.readCalibration.return_value = calibration()
        self.device.setIrLaserDotProjectorIntensity.return_value = True
        self.device.setIrFloodLightIntensity.return_value = False
        self.pipeline = mock.create_autospec(dai.Pipeline, instance=True)
        self.pipeline.create.side_effect = self._create
        self.nodes: list[tuple[str, Any]] = []
        monkeypatch.setattr(_device, "dai", SimpleNamespace(**{**vars(dai), "Pipeline": lambda device: self.pipeline}))

    def _create(self, kind: Any) -> Any:
        node = mock.create_autospec(kind, instance=True)
        if hasattr(kind, "build"):
            node.build.return_value = node
        node.name = f"{kind.__name__} {len(self.nodes)}"
        for port in ("depth", "inputAlignTo", "outputAligned", "input", "initialConfig"):
            if hasattr(kind, port):
                spec = dai.StereoDepthConfig if port == "initialConfig" else None
                setattr(node, port, mock.create_autospec(spec, instance=True) if spec else mock.Mock(name=port))
        self.nodes.append((kind.__name__, node))
        return node

    def build(self, **wishes: Any) -> Any:
        return _device.build(self.device, info("1844301041"), _device.Wishes(**wishes))


def test_the_pipeline_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOak(monkeypatch)
    source = fake.build(size=(640, 400), rate_hz=15.0, preset="ROBOTICS", dots=0.5)
    assert [kind for kind, _ in fake.nodes] == ["Camera", "Camera", "Camera", "StereoDepth"]
    color, left, right, stereo = (node for _, node in fake.nodes)
    color.build.assert_called_once_with(SOCKET.CAM_A)
    left.build.assert_called_once_with(SOCKET.CAM_B)
    right.build.assert_called_once_with(SOCKET.CAM_C)
    color.requestOutput.assert_called_once_with(
        (640, 400),
        type=dai.ImgFrame.Type.BGR888i,
        resizeMode=dai.ImgResizeMode.CROP,
        fps=15.0,
        enableUndistortion=True,
    )
    mode = dai.node.StereoDepth.PresetMode.ROBOTICS
    stereo.build.assert_called_once_with(
        left.requestOutput.return_value, right.requestOutput.return_value, presetMode=mode
    )
    stereo.initialConfig.setDepthUnit.assert_called_once_with(
        dai.StereoDepthConfig.AlgorithmControl.DepthUnit.MILLIMETER
    )
    color.requestOutput.return_value.link.assert_called_once_with(stereo.inputAlignTo)
    assert source.outputs == {"color": color.requestOutput.return_value, "depth": stereo.depth}
    assert source.sockets == {"color": SOCKET.CAM_A, "depth": SOCKET.CAM_A}
    identity = source.identity
    assert (identity.model, identity.serial, identity.port) == ("OAK-D-PRO", "1844301041", "4-1.2")
    assert identity.calibration == "factory"
    assert source.notes == ["USB speed SUPER"]
    fake.device.setIrLaserDotProjectorIntensity.assert_called_once_with(0.5)
    fake.device.setIrFloodLightIntensity.assert_not_called()
    fake.device.setMaxReconnectionAttempts.assert_called_once_with(0)
    fake.pipeline.setStopOnDeviceLoss.assert_called_once_with(True)
    fake.pipeline.start.assert_not_called()


def test_an_rvc4_aligns_in_a_node_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOak(monkeypatch, platform="RVC4")
    source = fake.build()
    color, _, _, stereo, align = (node for _, node in fake.nodes)
    stereo.depth.link.assert_called_once_with(align.input)
    color.requestOutput.return_value.link.assert_called_once_with(align.inputAlignTo)
    assert source.outputs["depth"] is align.outputAligned


def test_streams_that_are_not_wanted_are_not_built(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOak(monkeypatch, sockets="A")
    assert list(fake.build(streams=("color",)).outputs) == ["color"]
    assert [kind for kind, _ in fake.nodes] == ["Camera"]
    assert list(FakeOak(monkeypatch).build(streams=("depth",)).outputs) == ["depth"], "colour is what it is aligned to"


def test_what_a_camera_cannot_do_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OakError, match="has no pair of sensors at CAM_B and CAM_C.* --streams color"):
        FakeOak(monkeypatch, sockets="A").build()
    with pytest.raises(OakError, match="has no colour sensor"):
        FakeOak(monkeypatch, sockets="BC").build()
    with pytest.raises(OakError, match="no stereo preset FAST"):
        FakeOak(monkeypatch).build(preset="FAST")
    with pytest.raises(OakError, match="has no infrared flood light"):
        FakeOak(monkeypatch).build(flood=0.1)
    FakeOak(monkeypatch).build(flood=0.0)


def test_usb2_and_a_missing_calibration_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOak(monkeypatch)
    fake.device.getUsbSpeed.return_value = dai.UsbSpeed.HIGH
    fake.device.isCalibrationAvailable.return_value = False
    source = fake.build()
    assert any("it runs as a USB2 device" in note for note in source.notes)
    assert any("no calibration of its own" in note for note in source.notes)
    assert (source.calibration, source.identity.calibration) == (None, "none")
    assert not any("USB2 device" in note for note in fake.build(usb2=True).notes), "it was asked for"


def test_a_camera_that_goes_away_ends_the_bridge(
    folder: Path, images: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The pipeline of files stands in for a camera's; when it stops by itself, a camera was unplugged."""

    def gone(wishes: Any) -> tuple[Any, Any]:
        source = _replay.open_folder(images, serial="1", rate_hz=50.0, loop=False)
        source.frames = None  # a camera's frames do not wait
        return source, SimpleNamespace(close=lambda: closed.append(True))

    closed: list[bool] = []
    monkeypatch.setattr(_device, "open_camera", gone)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with fake_daemon(folder, camera="oak") as daemon:
        code = program.main(["--camera", "oak", "--rig", "mount", "--runtime-dir", str(folder), "--serial", "1"])
        assert code == Exit.LOST
        offer = daemon.until(state=ExternalState.ENDED)
        assert (offer["reason"], offer["text"]) == (
            ExternalReason.DISCONNECTED,
            "the camera is gone: unplugged, or its firmware stopped",
        )
    assert closed == [True]
    assert "unplugged" in caplog.text


def test_without_a_camera_it_says_so(folder: Path) -> None:
    with bridge(folder, "--serial", "18443010B1D25A0F00", "--wait", "0") as process:
        _, errors = process.communicate(timeout=WAIT_S)
        assert process.returncode == Exit.NO_CAMERA
        assert "no OAK camera with the serial number 18443010B1D25A0F00 was found" in errors
    done = subprocess.run(
        [sys.executable, "-m", "depthrig.oak", "--list"], capture_output=True, text=True, timeout=WAIT_S, check=False
    )
    assert done.returncode == 0
    # The SDK's own log goes there too.
    assert done.stdout.splitlines()[-1] == "no OAK camera is attached"


def test_the_documentation_names_every_option() -> None:
    text = (ROOT / "docs" / "cameras" / "oak.md").read_text()
    for action in program._parser()._actions:
        for option in action.option_strings:
            assert option in ("-h", "--help") or f"`{option}" in text or f" {option} " in text, option
    assert depthrig.__version__
