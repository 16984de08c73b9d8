"""A real camera: its choice by serial number, its pipeline, its description."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

import depthai as dai

from ._errors import Exit, OakError
from ._source import Identity, Source

log = logging.getLogger("depthrig.oak")

_STEREO_SIZE = (640, 400)
"""A size that the mono sensors of every OAK-D deliver and the depth engine of an RVC2 processes at 30 Hz."""


@dataclass(frozen=True)
class Wishes:
    """The user's settings for the camera."""

    serial: str | None = None
    size: tuple[int, int] = (1280, 720)
    rate_hz: float = 30.0
    color: str = "bgr8"
    streams: tuple[str, ...] = ("color", "depth")
    preset: str = "DEFAULT"
    dots: float | None = None
    """Intensity of the infrared dot projector, 0 to 1; None leaves it as it is."""
    flood: float | None = None
    """Intensity of the infrared flood light, 0 to 1."""
    undistorted: bool = True
    usb2: bool = False
    """Keep to USB2 also on a USB3 port."""
    timeout_s: float = 5.0
    """How long to look for the camera: after a firmware upload, or a restart, it enumerates anew."""


def find(serial: str | None, timeout_s: float) -> dai.DeviceInfo:
    """Return the camera with this serial number, or the only one there is; waits for one that is starting up.

    Raises OakError, naming those that are there.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        free = list(dai.Device.getAllAvailableDevices())
        fitting = [d for d in free if serial is None or d.getDeviceId() == serial]
        if len(fitting) == 1:
            return fitting[0]
        if len(fitting) > 1:
            raise OakError(
                f"{len(fitting)} OAK cameras are attached: {_named(fitting)}; choose one with --serial", Exit.USAGE
            )
        busy = [d for d in dai.Device.getAllConnectedDevices() if serial is None or d.getDeviceId() == serial]
        if time.monotonic() >= deadline:
            wanted = "no OAK camera" if serial is None else f"no OAK camera with the serial number {serial}"
            if busy:
                raise OakError(
                    f"{wanted} is free: {_named(busy)} is in use; end the program that has it, or plug the camera in "
                    "again",
                    Exit.NO_CAMERA,
                )
            there = f"attached are: {_named(free)}" if free else "none is attached"
            raise OakError(
                f"{wanted} was found, {there}; is it plugged in, and is the udev rule there (`depthrig install`)?",
                Exit.NO_CAMERA,
            )
        time.sleep(0.5)


def _named(devices: list[dai.DeviceInfo]) -> str:
    return ", ".join(f"{d.getDeviceId() or 'without a number'} ({d.name}, {_state(d)})" for d in devices)


def _state(device: dai.DeviceInfo) -> str:
    name = str(device.state.name)
    return name.replace("X_LINK_", "").lower()


def port(device: dai.DeviceInfo) -> str:
    """Return where a camera is attached: the USB port path as the kernel writes it, else its address."""
    name = str(device.name)
    # The SDK writes 4.1.2 for bus 4, ports 1 and 2 (XLink `usb_host.cpp`), the kernel 4-1.2.
    parts = name.split(".")
    if len(parts) >= 2 and all(part.isdigit() for part in parts) and device.protocol.name == "X_LINK_USB_VSC":
        return f"{parts[0]}-{'.'.join(parts[1:])}"
    return name


def open_camera(wishes: Wishes) -> tuple[Source, dai.Device]:
    """Open the camera and build its pipeline; nothing streams yet.

    Raises OakError when it is not there, is in use, or does not support the settings.
    """
    info = find(wishes.serial, wishes.timeout_s)
    try:
        device = dai.Device(info, dai.UsbSpeed.HIGH if wishes.usb2 else dai.UsbSpeed.SUPER_PLUS)
    except RuntimeError as e:
        raise OakError(
            f"OAK camera {info.getDeviceId()} at {port(info)} cannot be opened ({e}); does another program have it, "
            "and may this user write to its USB device (`depthrig install`)?",
            Exit.NO_CAMERA,
        ) from e
    try:
        source = build(device, info, wishes)
    except BaseException:
        device.close()
        raise
    return source, device


def build(device: dai.Device, info: dai.DeviceInfo, wishes: Wishes) -> Source:
    """Build the pipeline of an open camera: colour, and depth seen from where colour is taken."""
    # Both reset the camera's clock without notice.
    device.setMaxReconnectionAttempts(0)
    sockets = list(device.getConnectedCameras())
    socket = dai.CameraBoardSocket
    if socket.CAM_A not in sockets:
        raise OakError(f"OAK camera {info.getDeviceId()} has no colour sensor at socket CAM_A", Exit.USAGE)
    if "depth" in wishes.streams and not {socket.CAM_B, socket.CAM_C} <= set(sockets):
        raise OakError(
            f"OAK camera {info.getDeviceId()} has no pair of sensors at CAM_B and CAM_C, and so no depth; "
            "say --streams color",
            Exit.USAGE,
        )
    _lights(device, wishes)
    pipeline = dai.Pipeline(device)
    pipeline.setStopOnDeviceLoss(True)
    outputs: dict[str, dai.Node.Output] = {}
    kind = {"bgr8": dai.ImgFrame.Type.BGR888i, "rgb8": dai.ImgFrame.Type.RGB888i, "nv12": dai.ImgFrame.Type.NV12}
    color = pipeline.create(dai.node.Camera).build(socket.CAM_A)
    outputs["color"] = color.requestOutput(
        wishes.size,
        type=kind[wishes.color],
        resizeMode=dai.ImgResizeMode.CROP,
        fps=wishes.rate_hz,
        enableUndistortion=wishes.undistorted,
    )
    if "depth" in wishes.streams:
        outputs["depth"] = _depth(pipeline, device, outputs["color"], wishes)
    if "color" not in wishes.streams:
        del outputs["color"]
    speed = device.getUsbSpeed()
    notes = []
    if info.protocol.name == "X_LINK_USB_VSC":
        notes.append(f"USB speed {speed.name}")
        if speed in (dai.UsbSpeed.LOW, dai.UsbSpeed.FULL, dai.UsbSpeed.HIGH) and not wishes.usb2:
            notes.append(
                "it runs as a USB2 device, which carries few frames: move it to a USB3 socket, with a USB3 cable that "
                "is pushed in fully"
            )
    calibration = device.readCalibration() if device.isCalibrationAvailable() else None
    if calibration is None:
        notes.append("the camera has no calibration of its own: its frames carry no intrinsics")
    identity = Identity(
        model=str(device.getProductName() or device.getDeviceName() or "OAK"),
        serial=str(device.getDeviceId()),
        firmware=f"depthai {dai.__version__}",
        port=port(info),
        calibration="factory" if calibration is not None else "none",
    )
    return Source(
        pipeline=pipeline,
        outputs=outputs,
        identity=identity,
        rate_hz=wishes.rate_hz,
        calibration=calibration,
        # Depth is aligned to colour: both look from there.
        sockets=dict.fromkeys(outputs, socket.CAM_A),
        notes=notes,
    )


def _depth(pipeline: dai.Pipeline, device: dai.Device, color: dai.Node.Output, wishes: Wishes) -> dai.Node.Output:
    """Add the stereo depth, aligned to colour, in millimetres; return its output."""
    socket = dai.CameraBoardSocket
    left = pipeline.create(dai.node.Camera).build(socket.CAM_B)
    right = pipeline.create(dai.node.Camera).build(socket.CAM_C)
    preset = getattr(dai.node.StereoDepth.PresetMode, wishes.preset, None)
    if preset is None:
        raise OakError(f"this version of `depthai` has no stereo preset {wishes.preset}", Exit.USAGE)
    stereo = pipeline.create(dai.node.StereoDepth).build(
        left.requestOutput(_STEREO_SIZE, fps=wishes.rate_hz),
        right.requestOutput(_STEREO_SIZE, fps=wishes.rate_hz),
        presetMode=preset,
    )
    stereo.initialConfig.setDepthUnit(dai.StereoDepthConfig.AlgorithmControl.DepthUnit.MILLIMETER)
    # An RVC2 aligns inside the stereo node, an RVC4 in a node of its own (depthai-core `RGBD.cpp`, MIT).
    if device.getPlatform() == dai.Platform.RVC4:
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        color.link(align.inputAlignTo)
        return align.outputAligned
    color.link(stereo.inputAlignTo)
    return stereo.depth


def _lights(device: dai.Device, wishes: Wishes) -> None:
    for name, value, switch in (
        ("dot projector", wishes.dots, device.setIrLaserDotProjectorIntensity),
        ("flood light", wishes.flood, device.setIrFloodLightIntensity),
    ):
        if value is not None and not switch(value) and value > 0:
            raise OakError(f"OAK camera {device.getDeviceId()} has no infrared {name}", Exit.USAGE)


def listing() -> list[str]:
    """Return a line for each camera that is attached: serial number, place, state, and whether it is free."""
    free = {d.getDeviceId() for d in dai.Device.getAllAvailableDevices()}
    return [
        f"{d.getDeviceId() or '-'}  {port(d)}  {_state(d)}  {'free' if d.getDeviceId() in free else 'in use'}"
        for d in dai.Device.getAllConnectedDevices()
    ]
