"""Finding rigs: locks, folders, names, and the messages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import depthrig
from depthrig import _bus, _runtime

HOLD = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
file.write("process 42 (rig.toml)")
file.flush()
print("held", flush=True)
sys.stdin.read()
"""


class Lock:
    """Holds a rig's lock in another process, as a daemon does."""

    def __init__(self, folder: Path, rig: str) -> None:
        command = [sys.executable, "-c", HOLD, str(folder / f"{rig}.lock")]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "held\n"

    def free(self) -> None:
        self.process.kill()
        self.process.wait()


def test_only_held_locks_are_rigs(folder: Path) -> None:
    (folder / "stale.lock").write_text("process 1")
    (folder / "Bad Name.lock").touch()
    assert depthrig.running_rigs(folder) == []
    a, b = Lock(folder, "beta"), Lock(folder, "alpha")
    try:
        assert depthrig.running_rigs(folder) == ["alpha", "beta"]
        assert _runtime.holder(str(folder), "alpha") == "process 42 (rig.toml)"
        with pytest.raises(depthrig.AmbiguousRig, match="several rigs are running in .*: alpha, beta; say which"):
            depthrig.Stream("cam/depth", runtime_dir=folder, timeout=0)
        with pytest.raises(depthrig.RigNotRunning, match="rig 'gamma' is not running in .*; running there: alpha"):
            depthrig.Stream("cam/depth", rig="gamma", runtime_dir=folder, timeout=0)
        with pytest.raises(depthrig.StreamNotFound, match="the rig is running but has no stream yet"):
            depthrig.Stream("cam/depth", rig="alpha", runtime_dir=folder, timeout=0)
    finally:
        a.free()
        b.free()
    assert depthrig.running_rigs(folder) == []


def test_no_rig_says_how_to_start_one(folder: Path) -> None:
    missing = folder / "not_there"
    for rig in (None, "mount"):
        with pytest.raises(depthrig.RigNotRunning, match=r"running in .*not_there.*`depthrig run RIG.toml`"):
            depthrig.Stream("cam/depth", rig=rig, runtime_dir=missing, timeout=0)
    assert not missing.exists(), "a subscriber makes no folder"


def test_the_folder_is_found_as_the_daemon_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("DEPTHRIG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert _runtime.runtime_dir() == str(tmp_path / "depthrig")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "gone"))
    assert _runtime.runtime_dir() == f"/tmp/depthrig-{os.getuid()}"
    monkeypatch.setenv("DEPTHRIG_RUNTIME_DIR", str(tmp_path / "own"))
    assert _runtime.runtime_dir() == str(tmp_path / "own")
    assert _runtime.runtime_dir("/elsewhere") == "/elsewhere"


def test_a_folder_of_another_user_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(depthrig.BusError, match="belongs to user .* run as the daemon's user"):
        depthrig.Stream("cam/depth", runtime_dir=folder, timeout=0)


@pytest.mark.parametrize("name", ["depth", "", "Cam/depth", "cam/", "cam/4", "cam/a/b", "cam/" + "x" * 32, "cam/dépth"])
def test_a_bad_name_is_named(folder: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"CAMERA/STREAM|cannot be the name"):
        depthrig.Stream(name, runtime_dir=folder)


@pytest.mark.parametrize("version", ["0.9.3", "0.11.0", "1.0.0", "0.1"])
def test_another_wheel_is_refused_with_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    monkeypatch.setattr(_bus, "wheel_version", lambda: version)
    with pytest.raises(depthrig.VersionMismatch, match=rf"{version}, .* needs 0\.10: pip install 'iceoryx2==0\.10"):
        depthrig.Stream("cam/depth", rig="mount", runtime_dir=folder, timeout=0)


def test_without_the_wheel_the_import_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "iceoryx2.py").write_text("raise ImportError('GLIBC_2.34 not found')")
    code = "import depthrig"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ImportError: depthrig reads shared memory with the iceoryx2 wheel" in done.stderr
    assert "GLIBC_2.34 not found" in done.stderr
    assert "pip install 'iceoryx2==0.10.*'" in done.stderr
