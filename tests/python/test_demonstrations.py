"""Demonstrations from end to end: simulated cameras see an arm, whose process publishes its joints; episodes are recorded, one is
discarded, the daemon is killed in one; what was recovered becomes a dataset that LeRobot trains on and robomimic loads.

The values that must be in the export are NumPy's interpolation of the samples as Python's mcap reads them.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import depthrig
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr
from depthrig.policy import Observation, PolicyLoop
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from test_daemon import ROOT, WAIT_S, binary, command, environment, running, runtime, wait_until_answers

__all__ = ["binary", "runtime"]

LOADER = ROOT / ".venv-lerobot" / "bin" / "python"
JOINTS = ["base", "shoulder", "elbow", "wrist"]
VECTORS = {
    "observation.state": [("gripper/values", "fields"), ("joint_position/joint_states", "position")],
    "action": [("action/values", "fields")],
}
"""Topics and fields of the arm's vectors."""
GAPS = ("--max-gap", "2s")
"""On a busy computer the arm's process may be late by more than the 0.2 s that an export allows by itself."""
RIG = """
rig = "cell"
[sets]
rate_hz = 5.0
[recording]
reserve_mb = 16
[[camera]]
name = "top"
backend = "synthetic"
model = "d435"
arm = true
cache_dir = "cache"
[[camera.stream]]
name = "color"
width = 640
height = 480
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 640
height = 480
rate_hz = 15.0
"""


@contextmanager
def arm(binary: str, runtime: Path) -> Iterator[subprocess.Popen[bytes]]:  # noqa: F811
    """The robot's process."""
    program = Path(binary).parent / "examples" / "arm"
    if not program.exists():
        subprocess.run(["cargo", "build", "-p", "depthrig-tests", "--example", "arm"], cwd=ROOT, check=True)
    with subprocess.Popen([program, runtime]) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for_sets(recording: depthrig.Recording, more: int) -> None:
    def sets() -> int:
        return int((recording.status() or {}).get("sets", 0))

    until = sets() + more
    deadline = time.monotonic() + WAIT_S
    while sets() < until:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def wait_until_rendered(binary: str, runtime: Path) -> None:  # noqa: F811
    """Wait for the rendered images, which come in place of sketches; rendering has the lowest priority."""
    deadline = time.monotonic() + 5 * WAIT_S
    while True:
        asked = [binary, "status", "--json"]
        done = subprocess.run(asked, env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False)
        if done.returncode == 0:
            cameras = json.loads(done.stdout)
            if not cameras.get("preparing") and all(c["state"] == "streaming" for c in cameras["cameras"]):
                return
        assert time.monotonic() < deadline, done.stdout + done.stderr
        time.sleep(0.2)


def samples(dataset: Path, topic: str, values: str) -> tuple[np.ndarray, np.ndarray]:
    """UTC times, nanoseconds, and values of a signal, by Python's mcap."""
    times, rows = [], []
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, _, message, decoded in reader.iter_decoded_messages(topics=[topic]):
                times.append(message.publish_time)
                rows.append(
                    list(decoded.position) if values == "position" else [f.floats[0] for f in decoded.fields]
                )
    return np.array(times), np.array(rows)


def numbers_at(dataset: Path, times: np.ndarray, parts: list[tuple[str, str]]) -> np.ndarray:
    """The arm's signals at these times, by NumPy."""
    columns = []
    for topic, kind in parts:
        at, values = samples(dataset, f"/cell/arm/{topic}", kind)
        assert at[0] <= times[0] and times[-1] <= at[-1]
        columns += [np.interp(times - at[0], at - at[0], values[:, i]) for i in range(values.shape[1])]
    return np.stack(columns, axis=1)


def images(dataset: Path, topic: str) -> dict[int, np.ndarray]:
    """The image of each capture time, UTC nanoseconds, by Python's mcap and Pillow."""
    found = {}
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for schema, _, message, decoded in reader.iter_decoded_messages(topics=[topic]):
                if schema.name.endswith("CompressedImage"):
                    with Image.open(io.BytesIO(decoded.data)) as image:
                        found[message.publish_time] = np.asarray(image)
                else:
                    pixels = np.frombuffer(decoded.data, dtype="<u2")
                    found[message.publish_time] = pixels.reshape(decoded.height, decoded.width, 1)
    return found


def exported_rows(out: Path) -> list[dict]:
    return [r for f in sorted(out.rglob("data/**/*.parquet")) for r in pq.read_table(f).to_pylist()]


@pytest.fixture(scope="module")
def recovered(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """Five episodes, of which the third is discarded and the fifth is running when the daemon is killed."""
    folder = tmp_path_factory.mktemp("demonstrations")
    rig = folder / "rig.toml"
    rig.write_text(RIG)
    with arm(binary, runtime), running(binary, runtime, folder / "log", "run", str(rig), codes=(-signal.SIGKILL,)) as daemon:
        wait_until_rendered(binary, runtime)
        with depthrig.SignalReader("arm/action", runtime_dir=runtime) as reader:
            reader.wait(timeout=WAIT_S)
        recording = depthrig.Recording("cell", runtime)
        dataset = Path(recording.start(scene="table")["path"])
        for number in range(1, 5):
            with recording.episode(f"task {number % 2}"):
                wait_for_sets(recording, 10)
            recording.mark_episode("failure" if number == 2 else "success")
            if number == 3:
                recording.discard_episode()
        recording.start_episode("killed in it")
        # Sets are on the disk a second after they were recorded.
        wait_for_sets(recording, 12)
        daemon.kill()
        daemon.wait(WAIT_S)
    command(binary, runtime, "recover", str(dataset), codes=(0, 3))
    command(binary, runtime, "verify", "--decode", str(dataset), codes=(0, 3))
    return dataset


def test_the_export_has_the_arm_as_it_was_at_each_set(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    recovered: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "lerobot"
    said = command(binary, runtime, "export", "lerobot", str(recovered), str(out), *GAPS, codes=(0, 3))
    assert "episode 3 (discarded), episode 5 (running or cut off)" in said
    rows = exported_rows(out)
    assert {r["episode_index"] for r in rows} == {0, 1, 2}
    info = json.loads((out / "meta" / "info.json").read_text())
    state = info["features"]["observation.state"]
    assert state["names"] == ["arm/gripper.opening", *(f"arm/joint_position.{j}" for j in JOINTS)]
    assert "at most 2 s apart" in state["info"]["depthrig.interpolation"]

    times = np.array([r["capture.utc_ns"] for r in rows])
    for column, parts in VECTORS.items():
        got = np.array([r[column] for r in rows], dtype=np.float32)
        np.testing.assert_allclose(got, numbers_at(recovered, times, parts), rtol=3e-7, atol=1e-7)

    # The task was done at the end of the first and of the fourth episode.
    ends = [max(i for i, r in enumerate(rows) if r["episode_index"] == e) for e in (0, 1, 2)]
    assert [i for i, r in enumerate(rows) if r["next.success"]] == [ends[0], ends[2]]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    all_states = np.array([r["observation.state"] for r in rows])
    for name, value in [("min", all_states.min(0)), ("max", all_states.max(0)), ("mean", all_states.mean(0))]:
        np.testing.assert_allclose(stats["observation.state"][name], value, rtol=1e-5, atol=1e-6)


def test_zarr_has_the_rows_of_lerobot(binary: str, runtime: Path, recovered: Path, tmp_path: Path) -> None:  # noqa: F811
    lerobot, out = tmp_path / "lerobot", tmp_path / "replay.zarr"
    command(binary, runtime, "export", "lerobot", str(recovered), str(lerobot), *GAPS, codes=(0, 3))
    command(binary, runtime, "export", "zarr", str(recovered), str(out), *GAPS, codes=(0, 3))
    rows = exported_rows(lerobot)
    root = zarr.open(str(out), mode="r")
    data = root["data"]
    ends = root["meta/episode_ends"][:]
    episodes = np.array([r["episode_index"] for r in rows])
    assert list(ends) == [int(np.sum(episodes <= e)) for e in range(len(ends))]
    assert list(data["utc_ns"][:]) == [r["capture.utc_ns"] for r in rows]
    for name, column in [("state", "observation.state"), ("action", "action")]:
        np.testing.assert_array_equal(data[name][:], np.array([r[column] for r in rows], dtype=np.float32))
        assert not data[f"missing_{name}"][:].any()
    for i, row in enumerate(rows):
        color = Image.open(io.BytesIO(row["observation.images.top_color"]["bytes"])).convert("RGB")
        # Two decoders of JPEG.
        assert np.abs(data["top_color"][i].astype(int) - np.asarray(color).astype(int)).max() <= 3
        depth = np.asarray(Image.open(io.BytesIO(row["observation.images.top_depth"]["bytes"])))
        np.testing.assert_array_equal(data["top_depth"][i], depth)
    assert list(data["missing_top_depth"][:]) == [r["missing.top_depth"] for r in rows]
    said = root.attrs["depthrig"]
    assert said["vectors"][0]["names"] == ["arm/gripper.opening", *(f"arm/joint_position.{j}" for j in JOINTS)]
    assert [e["success"] for e in said["episodes"]] == [True, False, True]
    assert said["streams"][1]["depth_unit_m"] == 0.001


def test_hdf5_has_every_image_and_value(binary: str, runtime: Path, recovered: Path, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "hdf5"
    said = command(binary, runtime, "export", "hdf5", str(recovered), str(out), *GAPS, codes=(0, 3))
    assert "episode 3 (discarded), episode 5 (running or cut off)" in said
    # The sample after an episode's last set came with a set that is not of it.
    assert "without a value" not in said
    assert sorted(p.name for p in out.iterdir()) == ["demo.hdf5", "export.json"]
    color = images(recovered, "/cell/top/color/image_compressed")
    depth = images(recovered, "/cell/top/depth/image_raw")
    compared = 0
    with h5py.File(out / "demo.hdf5") as file:
        data = file["data"]
        assert list(data) == ["demo_0", "demo_1", "demo_2"]
        assert json.loads(data.attrs["env_args"]) == {"env_name": "cell", "type": 2, "env_kwargs": {}}
        assert data.attrs["total"] == sum(d.attrs["num_samples"] for d in data.values())
        assert [d.attrs["task"] for d in data.values()] == ["task 1", "task 0", "task 0"]
        assert [d.attrs["success"] for d in data.values()] == [True, False, True]
        assert {name: list(mask.asstr()) for name, mask in file["mask"].items()} == {
            "success": ["demo_0", "demo_2"],
            "failure": ["demo_1"],
        }
        for demo in data.values():
            rows = demo.attrs["num_samples"]
            times = demo["utc_ns"][:]
            assert rows >= 4 and (np.diff(times) > 0).all()
            assert list(demo["dones"]) == [0] * (rows - 1) + [1]
            assert demo["rewards"][:].sum() == demo["rewards"][-1] == demo.attrs["success"]
            for name, column in [("obs/state", "observation.state"), ("actions", "action")]:
                assert demo[name].dtype == np.float32
                expected = numbers_at(recovered, times, VECTORS[column])
                np.testing.assert_allclose(demo[name][:], expected, rtol=3e-7, atol=1e-7)
                assert not demo["missing"][name.removeprefix("obs/")][:].any()
            for row in range(rows):
                for name, stored in [("top_color", color), ("top_depth", depth)]:
                    at = demo["capture_utc_ns"][name][row]
                    assert demo["missing"][name][row] == (at == 0)
                    if at:
                        compared += 1
                        np.testing.assert_array_equal(demo["obs"][name][row], stored[at])
                    else:
                        assert not demo["obs"][name][row].any()
        assert compared >= 2 * 3 * 4
        facts = json.loads(file.attrs["depthrig"])
    assert facts["vectors"][0] == {
        "array": "state",
        "names": ["arm/gripper.opening", *(f"arm/joint_position.{j}" for j in JOINTS)],
    }
    assert "at most 2 s apart" in facts["interpolation"]
    assert facts["rate_hz"] == 5.0
    stream = facts["streams"][1]
    assert (stream["array"], stream["stream"], stream["depth_unit_m"]) == ("top_depth", "top/depth", 0.001)
    assert stream["intrinsics"]["fx"] > 100 and stream["pose_on_mount"]


def test_hdf5_marks_missing_images_and_the_others_are_in_their_rows(binary: str, runtime: Path, tmp_path: Path) -> None:  # noqa: F811
    rig, data = tmp_path / "rig.toml", tmp_path / "data"
    # Two of three sets have no depth.
    text = RIG.replace("rate_hz = 5.0", "rate_hz = 15.0").replace("[[camera.stream]]", "cheap = true\n[[camera.stream]]", 1)
    begin, end = text.rsplit("rate_hz = 15.0", 1)
    rig.write_text(f"{begin}rate_hz = 6.0{end}")
    with running(binary, runtime, tmp_path / "log", "run", str(rig), "--record", str(data), "--force"):
        deadline = time.monotonic() + WAIT_S
        while not list(data.rglob("session.toml")):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        wait_for_sets(depthrig.Recording("cell", runtime), 30)
    (dataset,) = data.iterdir()
    sets = []
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            sets += [(m.log_time, d) for _, _, m, d in reader.iter_decoded_messages(topics=["/cell/frame_set"])]
    depth = images(dataset, "/cell/top/depth/image_raw")
    command(binary, runtime, "export", "hdf5", str(dataset), str(tmp_path / "out"), codes=(0, 3))
    with h5py.File(tmp_path / "out" / "demo.hdf5") as file:
        demo = file["data/demo_0"]
        assert list(demo["utc_ns"]) == [time_ns for time_ns, _ in sets]
        assert "mask" not in file and "success" not in demo.attrs, "nobody judged it"
        missing = ["top/depth" in decoded.missing for _, decoded in sets]
        assert any(missing) and not all(missing)
        assert list(demo["missing/top_depth"]) == missing
        for row, (_, decoded) in enumerate(sets):
            taken = [m.capture_time_ns + decoded.utc_offset_ns for m in decoded.members if m.stream == "top/depth"]
            assert demo["capture_utc_ns/top_depth"][row] == sum(taken)
            expected = depth[taken[0]] if taken else np.zeros((480, 640, 1), np.uint16)
            np.testing.assert_array_equal(demo["obs/top_depth"][row], expected)


def test_robomimic_loads_hdf5(binary: str, runtime: Path, recovered: Path, tmp_path: Path) -> None:  # noqa: F811
    if not LOADER.exists():
        pytest.skip("the package robomimic is not installed (make test does it)")
    out, loaded = tmp_path / "hdf5", tmp_path / "loaded.npz"
    command(binary, runtime, "export", "hdf5", str(recovered), str(out), *GAPS, codes=(0, 3))
    names = ["state", "top_color", "top_depth"]
    call = [LOADER, Path(__file__).with_name("robomimic_loader.py"), out / "demo.hdf5", loaded, "success", *names]
    done = subprocess.run(call, capture_output=True, text=True, timeout=10 * WAIT_S, check=False)
    assert done.returncode == 0, done.stderr
    names_of_demos = json.loads(done.stdout.splitlines()[-1])
    assert names_of_demos == ["demo_0", "demo_2"]
    got = np.load(loaded)
    with h5py.File(out / "demo.hdf5") as file:
        demos = [file["data"][name] for name in names_of_demos]
        for name in ["actions", "rewards", "dones", *(f"obs/{n}" for n in names)]:
            expected = np.concatenate([d[name][:] for d in demos])
            np.testing.assert_array_equal(got[name.removeprefix("obs/")], expected)


def test_lerobot_trains_on_it(binary: str, runtime: Path, recovered: Path, tmp_path: Path) -> None:  # noqa: F811
    if not LOADER.exists():
        pytest.skip("the package lerobot is not installed (make test does it)")
    out = tmp_path / "lerobot"
    command(binary, runtime, "edit", str(recovered), "--episode", "5=success", codes=(0, 3))
    command(binary, runtime, "export", "lerobot", str(recovered), str(out), *GAPS, codes=(0, 3))
    script = Path(__file__).with_name("lerobot_train.py")
    call = [LOADER, script, out, "observation.images.top_color", "20"]
    offline = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf")}
    done = subprocess.run(call, env=offline, capture_output=True, text=True, timeout=10 * WAIT_S, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["episodes"] == 4
    assert said["tasks"] == ["task 1", "task 0", "killed in it"]
    assert said["action"] == [5]
    assert said["success"] == 3
    losses = said["losses"]
    assert len(losses) == 20 and np.isfinite(losses).all()
    assert np.mean(losses[-5:]) < np.mean(losses[:5])


def replayed(binary: str, runtime: Path, dataset: Path, log: Path) -> list[tuple[int, bytes, bytes]]:  # noqa: F811
    """Time, joints and pixels of each observation of a policy in a replay."""
    seen: list[tuple[int, bytes, bytes]] = []

    def policy(observation: Observation) -> None:
        pixels = observation["color"].tobytes() + observation["depth"].tobytes()
        seen.append((observation.time_ns, observation["joints"].tobytes(), pixels))

    call = ["replay", str(dataset), "--as-fast-as-possible", "--paused", "-q"]
    images = {"color": "top/color", "depth": "top/depth"}
    with running(binary, runtime, log, *call):
        wait_until_answers(runtime, "cell")
        options = {"rig": "cell", "runtime_dir": runtime, "max_gap": 0.2, "max_skew": 0.1, "timeout": WAIT_S}
        with PolicyLoop(images, {"joints": "arm/joint_position"}, **options) as loop:
            command(binary, runtime, "replay", "resume")
            loop.run(policy)
    return seen


def test_a_policy_sees_the_same_twice_in_a_replay(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    recovered: Path,
    tmp_path: Path,
) -> None:
    first = replayed(binary, runtime, recovered, tmp_path / "log")
    assert len(first) >= 20
    assert replayed(binary, runtime, recovered, tmp_path / "log") == first
    # The arm is where its process said, at the time of the image.
    at, values = samples(recovered, "/cell/arm/joint_position/joint_states", "position")
    with next(recovered.glob("seg_*.mcap")).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        offset = next(d.utc_offset_ns for _, _, _, d in reader.iter_decoded_messages(topics=["/cell/frame_set"]))
    for time_ns, joints, _ in first:
        when = time_ns + offset - at[0]
        expected = [np.interp(when, at - at[0], values[:, i]) for i in range(len(JOINTS))]
        np.testing.assert_allclose(np.frombuffer(joints), expected, rtol=0, atol=1e-12)


def test_a_gap_is_named_and_refused_or_masked(binary: str, runtime: Path, tmp_path: Path) -> None:  # noqa: F811
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.replace("[[camera.stream]]", "cheap = true\n[[camera.stream]]", 1))
    with running(binary, runtime, tmp_path / "log", "run", str(rig)):
        wait_until_rendered(binary, runtime)
        recording = depthrig.Recording("cell", runtime)
        with arm(binary, runtime):
            with depthrig.SignalReader("arm/action", runtime_dir=runtime, timeout=WAIT_S) as reader:
                reader.wait(timeout=WAIT_S)
            dataset = Path(recording.start()["path"])
            wait_for_sets(recording, 4)
        wait_for_sets(recording, 15)
        with arm(binary, runtime):
            wait_for_sets(recording, 8)
            recording.stop()
    out = tmp_path / "out"
    # A busy computer's arm is late by less.
    call = [binary, "export", "lerobot", str(dataset), str(out), "--max-gap", "1s"]
    refused = subprocess.run(call, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert refused.returncode == 2
    assert "signal arm/gripper has no samples at most 1 s apart" in refused.stderr
    assert "--gaps mask" in refused.stderr
    assert not out.exists()
    command(binary, runtime, *call[1:], "--gaps", "mask", codes=(0, 3))
    rows = exported_rows(out)
    missing = [r["missing.observation.state"] for r in rows]
    assert any(missing) and not missing[0] and not missing[-1]
    # The state that is held is the last one before the gap.
    first = missing.index(True)
    held = {tuple(r["observation.state"]) for r in rows[first : first + 2] if r["missing.observation.state"]}
    at, values = samples(dataset, "/cell/arm/joint_position/joint_states", "position")
    before = at <= rows[first]["capture.utc_ns"]
    np.testing.assert_allclose(next(iter(held))[1:], values[before][-1], rtol=3e-7)

    out = tmp_path / "hdf5"
    call = [binary, "export", "hdf5", str(dataset), str(out), "--max-gap", "1s"]
    refused = subprocess.run(call, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert refused.returncode == 2 and "--gaps mask" in refused.stderr and not out.exists()
    command(binary, runtime, *call[1:], "--gaps", "mask", codes=(0, 3))
    with h5py.File(out / "demo.hdf5") as file:
        demo = file["data/demo_0"]
        assert list(demo["missing/state"]) == missing
        states = np.array([r["observation.state"] for r in rows], dtype=np.float32)
        np.testing.assert_array_equal(demo["obs/state"][:], states)
