"""A running rig in rerun: what `python -m depthrig.view` sends is read back with rerun's own SDK and compared with what the cameras were given."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page import HEIGHT, PATCHES, RIG, SIMULATED, WIDTH, files_camera, free_port, pattern, until
from rerun.chunk import RrdReader
from test_daemon import ROOT, WAIT_S, binary, command, environment, running, runtime

__all__ = ["binary", "runtime"]

TURNED = """
[[camera]]
name = "turned"
backend = "files"
manifest = {manifest}
pose = {{ translation_m = [0.1, -0.2, 0.3], rotation_rpy_deg = [0.0, 90.0, 0.0] }}
"""


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a rig that runs."""
    folder = tmp_path_factory.mktemp("view")
    manifest = pattern(folder / "still")
    turned = TURNED.format(manifest=f'"{manifest}"')
    text = RIG.format(name="seen", port=free_port()) + files_camera("still", manifest) + turned
    (folder / "rig.toml").write_text(text + SIMULATED.format(name="front"))
    with running(binary, runtime, folder / "log", "run", str(folder / "rig.toml"), "-q"):
        wait_until_streaming(binary, runtime, "seen", 3)
        yield folder


def wait_until_streaming(binary: str, runtime: Path, rig: str, cameras: int) -> None:
    status = lambda: command(binary, runtime, "status", "--json", "--rig", rig, codes=(0, 1, 3))
    until(lambda: status().count('"streaming"') >= cameras, status)


def view(runtime: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = {**environment(runtime), "PYTHONPATH": str(ROOT / "python" / "src")}
    return subprocess.run(
        [sys.executable, "-m", "depthrig.view", *arguments],
        env=env,
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )


def components(path: Path) -> dict[str, dict[str, list[Any]]]:
    """The values of each component of each entity, in the order of the file."""
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        entity = found.setdefault(str(chunk.entity_path), {})
        for name in batch.schema.names:
            entity.setdefault(name, []).extend(v for v in batch.column(name) if v.is_valid)
    return found


def first(entity: dict[str, list[Any]], name: str) -> Any:
    """The first value of a component."""
    return entity[name][0].values[0]


def check(path: Path, jpeg: bool = False) -> None:
    """Poses, intrinsics, unit of depth and pixels are those of the rig."""
    found = components(path)
    for camera, translation, quaternion in (
        ("still", [0, 0, 0], [0, 0, 0, 1]),
        ("turned", [0.1, -0.2, 0.3], [0, np.sqrt(0.5), 0, np.sqrt(0.5)]),
    ):
        depth = found[f"/seen/{camera}/depth"]
        np.testing.assert_allclose(first(depth, "Transform3D:translation").as_py(), translation, atol=1e-6)
        np.testing.assert_allclose(first(depth, "Transform3D:quaternion").as_py(), quaternion, atol=1e-6)
        # Column by column.
        matrix = np.array(first(depth, "Pinhole:image_from_camera").as_py()).reshape(3, 3).T
        np.testing.assert_allclose(matrix, [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
        np.testing.assert_allclose(first(depth, "Pinhole:resolution").as_py(), [WIDTH, HEIGHT])
        # Right, down, forward.
        assert first(depth, "Pinhole:camera_xyz").as_py() == [3, 2, 5]
        assert first(depth, "DepthImage:meter").as_py() == pytest.approx(1000.0)
        millimetres = np.frombuffer(pixels(depth, "DepthImage:buffer"), "<u2").reshape(HEIGHT, WIDTH)
        for patch in PATCHES:
            assert millimetres[int(patch.y * HEIGHT), int(patch.x * WIDTH)] == patch.depth_mm
        color = found[f"/seen/{camera}/color"]
        if jpeg:
            assert first(color, "EncodedImage:media_type").as_py() == "image/jpeg"
            continue
        rgb = np.frombuffer(pixels(color, "Image:buffer"), "u1").reshape(HEIGHT, WIDTH, 3)
        for patch in PATCHES:
            assert tuple(rgb[int(patch.y * HEIGHT), int(patch.x * WIDTH)]) == patch.color


def pixels(entity: dict[str, list[Any]], name: str) -> bytes:
    return first(entity, name).values.to_numpy().tobytes()


def test_what_rerun_gets_is_what_the_cameras_were_given(runtime: Path, rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    done = view(runtime, "--save", str(out), "--seconds", "4", "--rate", "5")
    assert done.returncode == 0, done.stderr
    check(out)
    found = components(out)
    assert found.keys() >= {f"/seen/{c}/{s}" for c in ("still", "turned", "front") for s in ("color", "depth")}
    times = [t.value for t in found["/seen/front/depth"]["capture"]]
    assert times == sorted(set(times))
    # 20 are due; a busy computer may do less, never more.
    assert 4 <= len(times) <= 22, len(times)
    # Poses that do not change are sent once.
    assert len(found["/seen/front/depth"]["Transform3D:translation"]) == 1


def test_streams_are_chosen_and_colour_is_jpeg_on_demand(runtime: Path, rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    names = [f"{c}/{s}" for c in ("still", "turned") for s in ("color", "depth")]
    done = view(runtime, "--save", str(out), "--seconds", "2", "--jpeg", "90", "--rig", "seen", *names)
    assert done.returncode == 0, done.stderr
    check(out, jpeg=True)
    assert not any("front" in entity for entity in components(out))


def test_a_running_viewer_gets_the_frames(runtime: Path, rig: Path, tmp_path: Path) -> None:
    # rerun without a window, which keeps what it is sent.
    out = tmp_path / "out.rrd"
    port = free_port()
    rerun = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    assert rerun is not None
    with (tmp_path / "log").open("wb") as log:
        server = subprocess.Popen([rerun, "--save", str(out), "--port", str(port)], stdout=log, stderr=log)
        try:

            def has_all() -> bool:
                """Sends images and looks for all streams. A file that is still written may not be readable."""
                done = view(runtime, "--connect", f"rerun+http://127.0.0.1:{port}/proxy", "--seconds", "3")
                assert done.returncode == 0, done.stderr
                time.sleep(1)
                with suppress(RuntimeError):
                    found = components(out)
                    buffers = {"depth": "DepthImage:buffer", "color": "Image:buffer"}
                    wanted = [(f"/seen/{c}/{s}", buffer) for c in ("still", "turned") for s, buffer in buffers.items()]
                    return all(found.get(entity, {}).get(buffer) for entity, buffer in wanted)
                return False

            until(has_all, (tmp_path / "log").read_text)
        finally:
            server.terminate()
            server.wait(WAIT_S)
    check(out)


def test_mistakes_are_named(runtime: Path, rig: Path, tmp_path: Path) -> None:
    done = view(runtime, "--rig", "nobody", "--save", str(tmp_path / "x.rrd"))
    assert done.returncode == 1 and "nobody" in done.stderr
    for wrong in (("--rate", "0"), ("--jpeg", "101")):
        assert view(runtime, *wrong).returncode == 2


def test_the_end_of_the_rig_ends_the_view(binary: str, runtime: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG.format(name="ending", port=free_port()) + SIMULATED.format(name="front"))
    out = tmp_path / "out.rrd"
    arguments = ("run", str(tmp_path / "rig.toml"), "-q")
    with running(binary, runtime, tmp_path / "log", *arguments) as daemon, ThreadPoolExecutor() as pool:
        wait_until_streaming(binary, runtime, "ending", 1)
        viewing = pool.submit(view, runtime, "--rig", "ending", "--save", str(out))
        # It shows images.
        until(lambda: viewing.done() or (out.exists() and out.stat().st_size > 100_000))
        daemon.send_signal(signal.SIGINT)
        done = viewing.result()
        assert done.returncode == 0 and "rig ending has ended" in done.stderr, done.stderr
        daemon.wait(WAIT_S)
