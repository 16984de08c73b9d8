"""The mirror of the header against bytes that Rust wrote."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from depthrig import ClockDomain, Distortion, FrameFlags, Header, PixelFormat, VersionMismatch, _layout


@pytest.fixture(scope="module")
def dumped(binary: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, dict]:
    folder: Path = tmp_path_factory.mktemp("dump")
    subprocess.run([binary, "--dump", str(folder)], check=True)
    return (folder / "header.bin").read_bytes(), json.loads((folder / "header.json").read_text())


def test_every_field_reads_what_rust_wrote(dumped: tuple[bytes, dict]) -> None:
    raw, values = dumped
    header = Header(raw)
    read = header.to_dict()
    assert sorted(read) == sorted(values)
    for name, value in values.items():
        got = list(read[name]) if isinstance(read[name], (tuple, bytes)) else read[name]
        assert got == value, name


def test_the_dump_can_tell_fields_apart(dumped: tuple[bytes, dict]) -> None:
    _, values = dumped
    flat = [json.dumps(v) for v in values.values()]
    assert len(set(flat)) == len(flat), "two fields hold the same value, so a swap would go unseen"


def test_every_byte_is_written_back(dumped: tuple[bytes, dict]) -> None:
    raw, values = dumped
    assert Header.pack(Header(raw).to_dict()) == raw
    assert Header.pack(values | {"magic": bytes(values["magic"])}) == raw


def test_every_byte_belongs_to_one_field(dumped: tuple[bytes, dict]) -> None:
    raw, _ = dumped
    before = Header(raw).to_dict()
    owners = []
    for i in range(len(raw)):
        broken = bytearray(raw)
        broken[i] ^= 0x01
        after = Header(bytes(broken)).to_dict()
        owners.append([n for n in before if before[n] != after[n]])
    texts = [n for n, _, kind, count in _layout.FIELDS if kind == "u8" and count == 32]
    for i, owner in enumerate(owners):
        name = next(n for n, offset, kind, count in reversed(_layout.FIELDS) if offset <= i)
        # A byte behind a text's end is padding, and changes nothing.
        assert owner in ([name], []) if name in texts else owner == [name], (i, owner, name)


def test_what_follows_from_the_fields(dumped: tuple[bytes, dict]) -> None:
    header = Header(dumped[0])
    assert header.pixel_format is PixelFormat.Z16
    assert header.format_name == "z16"
    assert header.is_depth
    assert header.clock is ClockDomain.KERNEL
    assert header.intrinsics.distortion is Distortion.KANNALA_BRANDT4
    assert header.drops == {
        "device_gap": 101,
        "incomplete": 102,
        "wrong_size": 103,
        "device_error": 104,
        "out_of_order": 105,
        "no_slot": 106,
        "abandoned": 107,
        "queue_full": 108,
    }
    assert header.flags == FrameFlags.REPLAYED | FrameFlags.LATE | FrameFlags.SYNTHETIC
    assert header.flag_names == {"replayed", "late", "synthetic"}
    assert (header.replayed, header.synthetic, header.derived) == (True, True, False)
    assert header.stream_id == "camera_of_thirty_one_characters/depth_refined"
    assert header.intrinsics.matrix().tolist() == [[611.1, 0, 313.3], [0, 612.2, 244.4], [0, 0, 1]]
    # (0.5, -0.5, 0.5, -0.5) turns by 240 degrees about (-1, 1, -1) / sqrt 3: x -> -y, y -> -z, z -> x.
    assert header.pose.matrix().tolist() == [
        [0, 0, 1, 0.011],
        [-1, 0, 0, -0.022],
        [0, -1, 0, 0.033],
        [0, 0, 0, 1],
    ]
    refinement = header.refinement
    assert refinement is not None
    values = dumped[1]
    assert (refinement.engine, refinement.model) == (values["refiner"], values["refiner_model"])
    assert list(refinement.steps_s) == ["wait", "register", "prepare", "infer", "finish", "total"]
    assert list(refinement.steps_s.values()) == [ns / 1e9 for ns in values["stage_ns"]]
    assert refinement[3:] == (
        values["source_sequence"],
        values["capture_time_ns"],
        values["source_color_sequence"],
        values["source_color_capture_time_ns"],
    )
    for part in ("camera_of_thirty_one_characters/depth_refined", "641x482", "z16", "replayed", "'no_slot': 106"):
        assert part in repr(header)


def test_a_frame_that_nothing_refined_says_so(dumped: tuple[bytes, dict]) -> None:
    values = Header(dumped[0]).to_dict()
    assert Header(Header.pack(values | {"refiner": ""})).refinement is None
    refinement = Header(Header.pack(values | {"refiner": "fill", "refiner_model": ""})).refinement
    assert refinement is not None
    assert (refinement.engine, refinement.model) == ("fill", None)


@pytest.mark.parametrize(
    ("clock", "flags", "level"),
    [
        (1, 0, "full"),
        (1, FrameFlags.HEADER_TIME, "header"),
        (1, FrameFlags.HEADER_TIME | FrameFlags.METADATA_LOST, "arrival"),
        (1, FrameFlags.SYNTHETIC, "simulated"),
        (2, 0, "kernel"),
        (0, 0, "arrival"),
        (999, 0, "arrival"),
    ],
)
def test_a_frame_says_what_its_times_come_from(dumped: tuple[bytes, dict], clock: int, flags: int, level: str) -> None:
    values = Header(dumped[0]).to_dict() | {"clock_domain": clock, "flags": int(flags)}
    assert Header(Header.pack(values)).metadata_level == level


def test_text_with_an_invalid_tail_is_cut_there(dumped: tuple[bytes, dict]) -> None:
    values = Header(dumped[0]).to_dict()
    assert Header(Header.pack(values | {"model": "é".encode() * 2 + b"\xc3"})).model == "éé"


@pytest.mark.parametrize("change", [{"version": 2}, {"magic": b"NOPE"}, {"size": 776}])
def test_a_header_of_another_version_is_refused(dumped: tuple[bytes, dict], change: dict) -> None:
    header = Header(Header.pack(Header(dumped[0]).to_dict() | change))
    with pytest.raises(VersionMismatch, match="stream x: a frame has header version .* of the daemon's version"):
        header.check_version("stream x")


def test_codes_of_later_versions_are_no_crash(dumped: tuple[bytes, dict]) -> None:
    later = {"format": 999, "intrinsics.model": 999, "clock_domain": 999, "flags": 1 << 30}
    header = Header(Header.pack(Header(dumped[0]).to_dict() | later))
    assert header.pixel_format is None
    assert header.clock is None
    assert header.intrinsics.distortion is Distortion.UNKNOWN
    assert header.flag_names == frozenset()
    assert "unknown format 999" in repr(header)
