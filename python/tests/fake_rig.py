"""A publisher inside the test, through iceoryx2's own Python API: headers and times as a test wants them."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import iceoryx2 as iox2
import numpy as np

from depthrig import Header, PixelFormat, _bus, _layout

WIDTH, HEIGHT = 8, 6
BLANK = {n: ("" if (k, c) == ("u8", 32) else b"\0" * c if k == "u8" else [0] * c) for n, _, k, c in _layout.FIELDS}
BLANK |= {"magic": _layout.HEADER_MAGIC, "version": [_layout.HEADER_VERSION], "size": [_layout.HEADER_SIZE]}


class Channel:
    """One stream; its frames are z16 by default, each pixel holding the frame's number."""

    def __init__(self, bus: _bus.Bus, name: str, slot: int) -> None:
        self.camera, self.stream = name.split("/")
        self.sent = 0
        service_name = iox2.ServiceName.new(f"depthrig/mount/{name}")
        schema = iox2.AttributeSpecifier.new().define(
            iox2.AttributeKey.new("schema"), iox2.AttributeValue.new(_layout.SCHEMA)
        )
        builder = bus.node.service_builder(service_name).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        builder = builder.user_header(_bus.FRAME_HEADER).max_subscribers(16).history_size(1)
        builder = builder.subscriber_max_buffer_size(4).subscriber_max_borrowed_samples(16)
        self._service = builder.create_with_attributes(schema)
        self._events = bus.node.service_builder(service_name).event().create()
        self._publisher = self._service.publisher_builder().initial_max_slice_len(slot).create()
        self._notifier = self._events.notifier_builder().create()

    def pixels(self, sequence: int) -> np.ndarray:
        return np.full((HEIGHT, WIDTH), sequence, np.uint16)

    def send(self, capture_ns: int, pixels: np.ndarray | None = None, **fields: Any) -> None:
        self.sent += 1
        fields.setdefault("sequence", self.sent)
        array = self.pixels(self.sent) if pixels is None else np.ascontiguousarray(pixels)
        pixel_format = {np.dtype("u1"): PixelFormat.RGB8, np.dtype("u2"): PixelFormat.Z16}.get(
            array.dtype, PixelFormat.DEPTH_F32
        )
        values = {
            **BLANK,
            "camera": self.camera,
            "stream": self.stream,
            "capture_time_ns": capture_ns,
            "publish_time_ns": capture_ns,
            "format": int(pixel_format),
            "width": array.shape[1],
            "height": array.shape[0],
            "stride": array.nbytes // array.shape[0],
            "payload_len": array.nbytes,
            "depth_unit_m": 0.0 if pixel_format is PixelFormat.RGB8 else 0.001,
            **fields,
        }
        raw = Header.pack(values)
        sample = self._publisher.loan_slice_uninit(array.nbytes).assume_init()
        ctypes.memmove(sample.user_header_ptr, raw, len(raw))
        ctypes.memmove(sample.payload_ptr, array.ctypes.data, array.nbytes)
        sample.send()
        self._notifier.notify()


class FakeRig:
    """A rig of streams that the test publishes itself."""

    def __init__(self, folder: Path) -> None:
        self._bus = _bus.Bus.at(str(folder))
        self._channels: list[Channel] = []

    def channel(self, name: str, slot: int = WIDTH * HEIGHT * 4) -> Channel:
        self._channels.append(Channel(self._bus, name, slot))
        return self._channels[-1]

    def __enter__(self) -> FakeRig:
        return self

    def __exit__(self, *_: object) -> None:
        self._channels.clear()
