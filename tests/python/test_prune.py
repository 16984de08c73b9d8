"""`depthrig prune`: discarded episodes go for good, exports stay as they were, and a kill leaves one of both datasets."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import depthrig
import pytest
from test_collect import CODES, record_sets, rig_runs, states
from test_daemon import WAIT_S, binary, command, environment, runtime

__all__ = ["binary", "runtime"]

RIG = ("--rig", "prune")


@contextmanager
def publishing(runtime: Path) -> Iterator[None]:  # noqa: F811
    """A robot's process."""
    stop = threading.Event()

    def run() -> None:
        with depthrig.Signal("arm/joints", fields=["a", "b"], unit="rad", kind="joints", runtime_dir=runtime) as arm:
            number = 0
            while not stop.wait(0.02):
                arm.publish([number, number / 10])
                number += 1

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.fixture(scope="module")
def dataset(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """Four episodes, of which the first and the third are discarded, with a signal beside them."""
    folder = tmp_path_factory.mktemp("prune")
    with publishing(runtime), rig_runs(binary, runtime, folder, "prune"):
        command(binary, runtime, "record", "start", "--name", "cups", *RIG)
        for end in (["discard"], ["stop", "success"], ["discard"], ["stop"]):
            command(binary, runtime, "episode", "start", "--task", "put the cup away", *RIG)
            for _ in range(2):
                record_sets(binary, runtime, "prune")
            command(binary, runtime, "episode", *end, *RIG)
            record_sets(binary, runtime, "prune")
        command(binary, runtime, "record", "stop", *RIG, codes=CODES)
    return folder / "datasets" / "cups"


def hashes(folder: Path) -> dict[str, str]:
    files = (f for f in sorted(folder.rglob("*")) if f.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def exported(binary: str, runtime: Path, dataset: Path, out: Path) -> tuple[dict[str, str], dict[str, list[str]]]:  # noqa: F811
    """The files of LeRobot, and the images of ByteCameraDepth by stream in their order: they are named by their number in the dataset."""
    # A busy computer lets a publisher wait: gaps of signals are not what this is about.
    for kind, options in [("lerobot", ("--max-gap", "1m")), ("bytecameradepth", ())]:
        command(binary, runtime, "export", kind, str(dataset), str(out / kind), *options, codes=CODES)
    images: dict[str, list[str]] = {}
    for file in sorted((out / "bytecameradepth").rglob("*.png"), key=lambda f: int(f.stem.rpartition("_")[2])):
        images.setdefault(file.stem.rpartition("_")[0], []).append(hashlib.sha256(file.read_bytes()).hexdigest())
    assert set(images) == {"color", "depth"}
    files = hashes(out / "lerobot")
    # It states the sizes of the dataset's segments.
    files.pop("export.json")
    return files, images


def sets(binary: str, runtime: Path, dataset: Path) -> int:  # noqa: F811
    return json.loads(command(binary, runtime, "info", str(dataset), "--json", codes=CODES))["sets"]


def copied(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "data" / "cups"))


def test_exports_are_the_same_and_the_sets_are_gone(binary: str, runtime: Path, dataset: Path, tmp_path: Path) -> None:  # noqa: F811
    pruned = copied(dataset, tmp_path)
    (pruned / "mine.txt").write_text("mine")
    before = hashes(pruned)
    listed = command(binary, runtime, "prune", str(pruned))
    assert "would remove" in listed and "--yes" in listed and "episode 3: discarded" in listed
    would = json.loads(command(binary, runtime, "prune", str(pruned), "--json"))
    assert not would["removed"] and would["prunable"]["sets"] >= 4
    assert hashes(pruned) == before, "without --yes nothing changes"

    first = exported(binary, runtime, pruned, tmp_path / "before")
    size = sum(f.stat().st_size for f in pruned.glob("seg_*"))
    samples = command(binary, runtime, "cat", str(pruned), "--stream", "arm/joints").splitlines()
    there = sets(binary, runtime, pruned)
    done = json.loads(command(binary, runtime, "prune", str(pruned), "--yes", "--json", "-q"))
    assert done["removed"] and done["prunable"] == would["prunable"]
    assert sets(binary, runtime, pruned) == there - would["prunable"]["sets"]
    assert size - sum(f.stat().st_size for f in pruned.glob("seg_*")) >= would["prunable"]["bytes"] / 2
    command(binary, runtime, "verify", str(pruned), "--decode", codes=CODES)
    assert states(binary, runtime, str(pruned)) == ["success", "kept"]
    assert exported(binary, runtime, pruned, tmp_path / "after") == first
    assert (pruned / "mine.txt").read_text() == "mine" and not (pruned / "report.html").exists()
    assert [p.name for p in pruned.parent.iterdir()] == ["cups"]
    assert "discarded episodes 1, 3" in command(binary, runtime, "edit", str(pruned))
    # Samples of signals go with their sets.
    kept = command(binary, runtime, "cat", str(pruned), "--stream", "arm/joints").splitlines()
    assert set(kept) < set(samples) and len(kept) > 10
    assert "nothing to remove" in command(binary, runtime, "prune", str(pruned), "--yes")


def test_a_kill_leaves_one_of_both_datasets(binary: str, runtime: Path, dataset: Path, tmp_path: Path) -> None:  # noqa: F811
    whole = sets(binary, runtime, dataset)
    kept = whole - json.loads(command(binary, runtime, "prune", str(dataset), "--json"))["prunable"]["sets"]
    chance = random.Random(3)
    length = None
    for attempt in range(12):
        pruned = copied(dataset, tmp_path / str(attempt))
        begin = time.monotonic()
        process = subprocess.Popen(
            [binary, "prune", str(pruned), "--yes"], env=environment(runtime), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if length is None:
            assert process.wait(WAIT_S) == 0
            length = time.monotonic() - begin
        else:
            time.sleep(chance.uniform(0, length))
            process.send_signal(signal.SIGKILL)
            process.wait(WAIT_S)
        assert sets(binary, runtime, pruned) in (whole, kept)
        command(binary, runtime, "verify", str(pruned), codes=CODES)
        command(binary, runtime, "prune", str(pruned), "--yes")
        assert sets(binary, runtime, pruned) == kept
        assert [p.name for p in pruned.parent.iterdir()] == ["cups"]
        shutil.rmtree(pruned)
