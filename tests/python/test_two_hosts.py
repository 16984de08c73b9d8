"""Two computers as one rig: two daemons in namespaces with clocks that are 1234 s apart, recorded, joined, and held against the truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from test_daemon import CAMERAS, DATA, ROOT, WAIT_S, binary, command, environment, runtime  # noqa: F401
from test_link_clock import HOSTS, SHIFT_NS, namespaces

HOST_CAMERAS = {"right": CAMERAS[:3], "left": CAMERAS[3:]}
LINKS = {"right": 'listen = "10.77.0.1:7447"', "left": 'recorder = "10.77.0.1:7447"'}
PERIOD_NS = 200_000_000
CAMERA_PERIOD_NS = 33_333_333


def rig_file(folder: Path, host: str) -> Path:
    lines = ['rig = "mount"', "[link]", f'host = "{host}"', LINKS[host], "insecure = true", "[control]", 'tcp = "off"']
    lines += ["[recording]", "reserve_mb = 64", "min_minutes = 0"]
    for camera in HOST_CAMERAS[host]:
        manifest = json.dumps(str(ROOT / "tests" / "data" / f"{camera.name}.toml"))
        lines += ["[[camera]]", f'name = "{camera.name}"', 'backend = "files"', f"manifest = {manifest}"]
    path = folder / f"{host}.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def messages(dataset: Path) -> Iterator[tuple[str, Any, bytes]]:
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            for _, channel, message, value in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
                yield channel.topic, value, message.data


@pytest.fixture(scope="module")
def datasets(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:  # noqa: F811
    """A recording of each host, and both joined."""
    folder = tmp_path_factory.mktemp("hosts")
    namespaces()
    scripts = {}
    for host in HOST_CAMERAS:
        own = runtime / host
        own.mkdir(mode=0o700)
        call = f"{binary} run {rig_file(folder, host)} --record {folder / host} --seconds 12 >{folder / host}.log 2>&1"
        scripts[host] = f"export DEPTHRIG_RUNTIME_DIR={own}; {call}; echo $? >{folder / host}.code"
    # The other host ends with this one's input; this one waits for its recording.
    wait = f"; for _ in $(seq {10 * WAIT_S:.0f}); do [ -s {folder}/left.code ] && break; sleep 0.1; done"
    hosts = [sys.executable, str(HOSTS), "--shift", str(SHIFT_NS), "bash", "-c", scripts["left"], "--"]
    done = subprocess.run(
        ["unshare", "-Urn", *hosts, "bash", "-c", scripts["right"] + wait],
        env={**os.environ, "DEPTHRIG_TEST_DATA": str(DATA)},
        capture_output=True,
        text=True,
        timeout=4 * WAIT_S,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    logs = done.stderr + "".join((folder / f"{host}.log").read_text() for host in HOST_CAMERAS)
    assert done.returncode == 0, logs
    assert all((folder / f"{host}.code").read_text().strip() in ("0", "3") for host in HOST_CAMERAS), logs
    found = {host: next(p for p in (folder / host).iterdir() if p.is_dir()) for host in HOST_CAMERAS}
    join = ["replay", str(found["right"]), str(found["left"]), "--as-fast-as-possible", "-q", "--force"]
    command(binary, runtime, *join, "--record", str(folder / "joined"))
    return {**found, "joined": next((folder / "joined").iterdir())}


def test_every_frame_of_both_is_in_the_joined_dataset_byte_for_byte(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    datasets: dict[str, Path],
) -> None:
    def images(host: str) -> dict[tuple[str, int], bytes]:
        found = {}
        for topic, value, _ in messages(datasets[host]):
            if hasattr(value, "data") and hasattr(value, "header"):
                at = value.header.stamp.sec * 1_000_000_000 + value.header.stamp.nanosec
                found[topic, at] = bytes(value.data)
        return found

    def sequence(host: str) -> dict[str, list[bytes]]:
        by_topic: dict[str, list[bytes]] = {}
        for (topic, _), data in images(host).items():
            by_topic.setdefault(topic, []).append(data)
        return by_topic

    assert sequence("joined") == {**sequence("right"), **sequence("left")}
    said = json.loads(command(binary, runtime, "verify", "--decode", "--json", str(datasets["joined"]), codes=(0, 3)))
    assert [f for f in said["findings"] if f["severity"] == "broken"] == []


def test_sets_lie_on_one_grid_and_are_as_tight_as_those_of_one_host(datasets: dict[str, Path]) -> None:
    sets = {host: [v for topic, v, _ in messages(path) if topic == "/mount/frame_set"] for host, path in datasets.items()}
    assert all(s.tick_ns % PERIOD_NS == 0 for s in sets["right"])
    # A host that just learned the clock has a tick or two beside the grid.
    topics = [topic for topic, _, _ in messages(datasets["left"])]
    without = topics[: topics.index("/mount/left/link_clock/values")].count("/mount/frame_set")
    left = [(s.tick_ns - SHIFT_NS) % PERIOD_NS for s in sets["left"][without + 2 :]]
    assert left and all(min(t, PERIOD_NS - t) < 1_000_000 for t in left)
    both = [s for s in sets["joined"] if len(s.missing) == 0]
    assert len(both) >= 20
    assert all(min(s.tick_ns % PERIOD_NS, -s.tick_ns % PERIOD_NS) < 1_000_000 for s in both[2:])
    # The frames nearest to one tick are at most a period of the cameras apart, as on one computer.
    assert max(s.spread_ns for s in both[2:]) <= CAMERA_PERIOD_NS + 1_000_000


def test_times_are_those_of_the_session_within_the_uncertainty(datasets: dict[str, Path]) -> None:
    def frames(host: str) -> dict[str, list[Any]]:
        found: dict[str, list[Any]] = {}
        for topic, value, _ in messages(datasets[host]):
            if topic.endswith("/frame_info"):
                found.setdefault(topic, []).append(value)
        return found

    joined = frames("joined")
    left = [(topic, value) for topic, value, _ in messages(datasets["left"])]
    known = next(i for i, (topic, _) in enumerate(left) if topic == "/mount/left/link_clock/values")
    # The bound shrinks with the answers of the first second.
    narrow_ns = min(value.capture_time_ns for topic, value in left[known:] if topic.endswith("/frame_info")) + 1_000_000_000
    checked = 0
    for topic, locals_ in frames("left").items():
        for local, session in zip(locals_, joined[topic], strict=True):
            truth = local.capture_time_ns - SHIFT_NS
            bound = session.capture_uncertainty_ns - local.capture_uncertainty_ns
            assert abs(session.capture_time_ns - truth) <= bound
            assert bound < 5_000_000 or local.capture_time_ns < narrow_ns
            checked += 1
    for topic, locals_ in frames("right").items():
        assert [v.capture_time_ns for v in joined[topic]] == [v.capture_time_ns for v in locals_]
    assert checked > 100


def test_a_joined_dataset_is_on_the_clock_of_the_session_already(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    datasets: dict[str, Path],
    tmp_path: Path,
) -> None:
    def times(dataset: Path) -> list[tuple[str, int]]:
        return [(t, v.capture_time_ns) for t, v, _ in messages(dataset) if t.endswith("/frame_info")]

    parts = [tmp_path / "begin", tmp_path / "end"]
    for part, span in zip(parts, (["--to", "4"], ["--from", "4.05"]), strict=True):
        command(binary, runtime, "trim", str(datasets["joined"]), str(part), *span)
    join = ["replay", *map(str, parts), "--as-fast-as-possible", "-q", "--force", "--record", str(tmp_path / "again")]
    command(binary, runtime, *join)
    (again,) = (tmp_path / "again").iterdir()
    assert sorted(times(again)) == sorted(times(parts[0]) + times(parts[1]))


def test_the_clock_is_no_state_of_a_robot(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    datasets: dict[str, Path],
    tmp_path: Path,
) -> None:
    command(binary, runtime, "export", "lerobot", str(datasets["right"]), str(tmp_path / "out"), "--incomplete", "leave-out")
    features = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())["features"]
    assert any(name.startswith("observation.images") for name in features)
    assert "observation.state" not in features
