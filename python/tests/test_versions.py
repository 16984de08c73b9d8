"""Channels made by another version of depthrig: refused with what to do, never misread."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import iceoryx2 as iox2
import pytest

import depthrig
from depthrig import _bus, _layout


def header_of(name: str, size: int) -> type[ctypes.Structure]:
    class Foreign(ctypes.Structure):
        _fields_ = (("words", ctypes.c_uint64 * (size // 8)),)

        @staticmethod
        def type_name() -> str:
            return name

    return Foreign


def make_channel(folder: Path, header: type[ctypes.Structure], schema: str | None, event: bool = True) -> Any:
    """Creates the channel of cam/depth as another version would; the returned ports keep it alive."""
    bus = _bus.Bus.at(str(folder))
    name = iox2.ServiceName.new("depthrig/mount/cam/depth")
    attributes = iox2.AttributeSpecifier.new()
    if schema is not None:
        attributes = attributes.define(iox2.AttributeKey.new("schema"), iox2.AttributeValue.new(schema))
    builder = bus.node.service_builder(name).publish_subscribe(iox2.Slice[ctypes.c_uint8])
    service = builder.user_header(header).create_with_attributes(attributes)
    events = bus.node.service_builder(name).event().create() if event else None
    publisher = service.publisher_builder().initial_max_slice_len(64).create()
    return service, events, publisher


def open_stream(folder: Path) -> depthrig.Stream:
    return depthrig.Stream("cam/depth", rig="mount", runtime_dir=folder, timeout=0)


@pytest.mark.parametrize(
    ("name", "size", "schema"),
    [
        (_layout.HEADER_TYPE, _layout.HEADER_SIZE, "depthrig.frame/2"),
        (_layout.HEADER_TYPE, _layout.HEADER_SIZE, None),
        ("depthrig.FrameHeader.v2", _layout.HEADER_SIZE, _layout.SCHEMA),
        (_layout.HEADER_TYPE, _layout.HEADER_SIZE + 8, _layout.SCHEMA),
    ],
    ids=["another schema", "no schema", "another type", "another size"],
)
def test_another_version_is_refused(folder: Path, name: str, size: int, schema: str | None) -> None:
    _channel = make_channel(folder, header_of(name, size), schema)
    with pytest.raises(
        depthrig.VersionMismatch,
        match=r"stream cam/depth of rig 'mount': it was made by another version .* install the `depthrig` package",
    ):
        open_stream(folder)


def test_a_frame_of_another_header_version_is_refused(folder: Path) -> None:
    """The channel fits and the frame does not: nobody should do that, and nobody should misread it."""
    channel = make_channel(folder, _bus.FRAME_HEADER, _layout.SCHEMA)
    stream = open_stream(folder)
    for version in (0, 2):
        sample = channel[2].loan_slice_uninit(64).assume_init()
        values = {n: (b"\0" * c if k == "u8" else [0] * c) for n, _, k, c in _layout.FIELDS}
        raw = depthrig.Header.pack({**values, "magic": b"DRFH", "version": [version], "size": [768]})
        ctypes.memmove(sample.user_header_ptr, raw, len(raw))
        sample.send()
        with pytest.raises(depthrig.VersionMismatch, match=f"header version {version} .* reads version 1"):
            stream.latest()


def test_a_corrupted_service_is_another_version_of_iceoryx2(folder: Path) -> None:
    """The errors of iceoryx2 0.9 and 0.10 on each other's channels; here the file of the channel is spoilt by hand."""
    _channel = make_channel(folder, _bus.FRAME_HEADER, _layout.SCHEMA)
    files = list(folder.rglob("*.service"))
    assert files
    for file in files:
        mode = file.stat().st_mode
        file.chmod(0o600)
        file.write_bytes(b"another version's bytes")
        file.chmod(mode)  # a file that is still writable counts as incomplete
    with pytest.raises(depthrig.VersionMismatch, match="ServiceInCorruptedState"):
        open_stream(folder)


def test_a_channel_without_its_event_is_an_error(folder: Path) -> None:
    _channel = make_channel(folder, _bus.FRAME_HEADER, _layout.SCHEMA, event=False)
    with pytest.raises(depthrig.BusError, match="its event cannot be opened"):
        open_stream(folder)


def test_too_many_subscribers_is_an_error(folder: Path) -> None:
    channel = make_channel(folder, _bus.FRAME_HEADER, _layout.SCHEMA)
    limit = channel[0].static_config.max_subscribers
    streams = [open_stream(folder) for _ in range(limit)]
    with pytest.raises(depthrig.BusError, match=f"all of its {limit} places for subscribers are taken"):
        open_stream(folder)
    streams.pop().close()
    open_stream(folder)
