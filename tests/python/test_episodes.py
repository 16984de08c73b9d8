"""Episodes: demonstrations are begun, judged and discarded in a running recording, which is killed, recovered and exported."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from pathlib import Path

import depthrig
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from test_daemon import ROOT, WAIT_S, binary, command, environment, rig_file, running, runtime

__all__ = ["binary", "rig_file", "runtime"]

RIG = ("--rig", "images")
TASK = 'put "the cup" on\nthe plate \N{TEACUP WITHOUT HANDLE}'


def episode(binary: str, runtime: Path, *arguments: str) -> dict:  # noqa: F811
    return json.loads(command(binary, runtime, "episode", *arguments, "--json", *RIG))


def refused(binary: str, runtime: Path, *arguments: str) -> str:  # noqa: F811
    """What a command says that fails."""
    done = subprocess.run(
        [binary, *arguments, *RIG], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
    )
    assert done.returncode == 1, done.stdout
    return done.stderr


def sets_recorded(binary: str, runtime: Path) -> int:  # noqa: F811
    return json.loads(command(binary, runtime, "record", "status", "--json", *RIG))["sets"]


def wait_for_sets(binary: str, runtime: Path, more: int) -> None:  # noqa: F811
    """Until so many more sets are recorded."""
    until = sets_recorded(binary, runtime) + more
    deadline = time.monotonic() + WAIT_S
    while sets_recorded(binary, runtime) < until:
        assert time.monotonic() < deadline
        time.sleep(0.1)


def set_times(dataset: Path) -> list[int]:
    """Log times of the sets, by Python's mcap."""
    times = []
    for segment in sorted(dataset.glob("seg_*.mcap")):
        with segment.open("rb") as file:
            times += [m.log_time for _, c, m in make_reader(file).iter_messages() if c.topic.endswith("/frame_set")]
    return sorted(times)


def test_demonstrations_survive_a_kill_and_become_episodes_of_lerobot(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig_file: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    with running(binary, runtime, tmp_path / "log", "run", str(rig_file), codes=(-signal.SIGKILL,)) as daemon:
        with depthrig.Stream("lingbot_0/depth", runtime_dir=runtime, timeout=WAIT_S) as stream:
            stream.next(timeout=WAIT_S)
        assert "record start" in refused(binary, runtime, "episode", "start")
        command(binary, runtime, "record", "start", "--name", "cups", *RIG)
        assert "no episode is running" in refused(binary, runtime, "episode", "stop")
        wait_for_sets(binary, runtime, 1)

        first = episode(binary, runtime, "start", "--task", TASK)
        assert (first["number"], first["task"]) == (1, TASK)
        assert "episode 1 is running" in refused(binary, runtime, "episode", "start")
        wait_for_sets(binary, runtime, 3)
        first = episode(binary, runtime, "stop", "success")
        wait_for_sets(binary, runtime, 2)

        episode(binary, runtime, "start", "--task", "dropped")
        wait_for_sets(binary, runtime, 1)
        assert episode(binary, runtime, "discard")["discarded"]

        episode(binary, runtime, "start", "--task", "another")
        wait_for_sets(binary, runtime, 4)
        episode(binary, runtime, "stop")
        third = episode(binary, runtime, "mark", "failure")
        assert (third["number"], third["outcome"]) == (3, "failure")
        shown = command(binary, runtime, "record", "status", *RIG)
        assert "2 episodes, 1 discarded" in shown

        episode(binary, runtime, "start", "--task", "killed in it")
        wait_for_sets(binary, runtime, 12)
        daemon.kill()
        daemon.wait(WAIT_S)

    dataset = rig_file.parent / "datasets" / "cups"
    command(binary, runtime, "recover", str(dataset), codes=(0, 3))
    info = json.loads(command(binary, runtime, "info", str(dataset), "--json", codes=(0, 3)))
    assert [e["number"] for e in info["episodes"]] == [1, 2, 3, 4]
    assert "end_utc_ns" not in info["episodes"][3]

    times = set_times(dataset)
    expected = [[t for t in times if e["start_utc_ns"] <= t <= e["end_utc_ns"]] for e in (first, third)]
    assert all(len(e) >= 1 for e in expected)
    out = tmp_path / "lerobot"
    said = command(binary, runtime, "export", "lerobot", str(dataset), str(out), codes=(0, 3))
    assert "episode 2 (discarded), episode 4 (running or cut off)" in said
    rows = [r for f in sorted(out.rglob("data/**/*.parquet")) for r in pq.read_table(f).to_pylist()]
    found = [[r["capture.utc_ns"] for r in rows if r["episode_index"] == i] for i in (0, 1)]
    assert found == expected
    assert len(rows) == sum(map(len, expected))
    tasks = pq.read_table(out / "meta" / "tasks.parquet").to_pylist()
    assert {row.get("task") or row["__index_level_0__"] for row in tasks} == {TASK, "another"}

    # Somebody looks at the one that was cut off, and judges it.
    command(binary, runtime, "edit", str(dataset), "--episode", "4=success", "--episode", "1=discard", codes=(0, 3))
    again = tmp_path / "again"
    said = command(binary, runtime, "export", "lerobot", str(dataset), str(again), codes=(0, 3))
    assert "episode 1 (discarded), episode 2 (discarded)" in said
    rows = [r for f in sorted(again.rglob("data/**/*.parquet")) for r in pq.read_table(f).to_pylist()]
    last = [t for t in times if t >= info["episodes"][3]["start_utc_ns"]]
    assert [r["capture.utc_ns"] for r in rows if r["episode_index"] == 1] == last


def test_a_python_program_steers_its_recording_and_episodes(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    rig_file: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    with pytest.raises(depthrig.RigNotRunning):
        depthrig.Recording(runtime_dir=runtime)
    # 3: intact, but a busy computer may lose a set.
    with running(binary, runtime, tmp_path / "log", "run", str(rig_file)):
        with depthrig.Stream("lingbot_0/depth", runtime_dir=runtime, timeout=WAIT_S) as stream:
            stream.next(timeout=WAIT_S)
        recording = depthrig.Recording(runtime_dir=runtime)
        assert (recording.rig, recording.status()) == ("images", None)
        with pytest.raises(depthrig.RigRefused, match="no recording is going on") as refusal:
            recording.start_episode()
        assert refusal.value.kind == "wrong_state"

        started = recording.start(scene="kitchen", notes="by a program", name="python")
        recording.note("the lamp is on")
        with recording.episode(TASK) as first:
            with pytest.raises(depthrig.RigRefused, match="episode 1 is running"):
                recording.start_episode()
            wait_for_sets(binary, runtime, 1)
        assert (first.number, first.task, first.end_utc_ns) == (1, TASK, None)
        with pytest.raises(KeyError), recording.episode("fails"):
            raise KeyError
        with pytest.raises(depthrig.RigRefused, match="unknown episode 7"):
            recording.mark_episode("success", 7)
        with pytest.raises(depthrig.RigRefused):
            recording.mark_episode("perhaps")
        assert recording.mark_episode("success", 1).outcome == "success"
        # As the documents have it.
        text = (ROOT / "docs" / "episodes.md").read_text()
        (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "Recording()" in block]
        code = code.replace("Recording()", "Recording(runtime_dir=folder)")
        assert recording.start_episode("to the end").number == 3
        stopped = recording.stop()
        assert (stopped["episodes"], stopped["episode"]["number"]) == (2, 3)
        assert "end_utc_ns" in stopped["episode"]
        exec(code, {"depthrig": depthrig, "time": time, "folder": runtime})
        judged = recording.status()
        assert judged is not None
        assert (judged["active"], judged["episodes"], judged["episode"]["outcome"]) == (False, 1, "success")
        ended = json.loads(command(binary, runtime, "info", str(started["path"]), "--json", codes=(0, 3)))
        assert [e["number"] for e in ended["episodes"]] == [1, 2, 3]
    gone = recording
    with pytest.raises(depthrig.RigNotRunning):
        gone.status()
    info = json.loads(command(binary, runtime, "info", str(started["path"]), "--json", codes=(0, 3)))
    states = [(e.get("outcome"), e.get("discarded", False)) for e in info["episodes"]]
    assert states == [("success", False), (None, True), (None, False)]
