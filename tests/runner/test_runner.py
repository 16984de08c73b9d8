"""The runner itself: time limits kill hanging tests with all that they started; skipped tests are counted by name."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
BOX = HERE / "box.py"
RUST = HERE / "rust.py"
PYTHON_TESTS = HERE.parents[1] / "python" / "tests"
LIMIT_S = 120
"""Longer than anything takes on a loaded machine: only for what would otherwise hang."""


def run(*command: object, **more: str) -> subprocess.CompletedProcess[str]:
    # This test may itself run as an ordinary user already.
    env = {k: v for k, v in os.environ.items() if k not in ("DEPTHRIG_TEST_USER", "DEPTHRIG_TEST_SKIPS")} | more
    argv = [sys.executable, *map(str, command)]
    return subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False, env=env)


def alive(pid_file: Path) -> bool:
    pid = int(pid_file.read_text())
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_a_limit_kills_what_left_the_process_group(tmp_path: Path) -> None:
    script = f"setsid sh -c 'trap \"\" TERM INT; echo $$ >{tmp_path}/pid; sleep 1000' & sleep 1000"
    done = run(BOX, "--limit", "2", "--", "sh", "-c", script)
    assert done.returncode == 124, done
    assert "ran past its limit of 2 s" in done.stderr
    assert not alive(tmp_path / "pid")


def test_what_is_left_running_is_killed_and_named(tmp_path: Path) -> None:
    script = f"setsid sleep 1000 & echo $! >{tmp_path}/pid; exit 3"
    done = run(BOX, "--", "sh", "-c", script)
    assert done.returncode == 3
    assert "left running: " in done.stderr
    assert not alive(tmp_path / "pid")


def test_busy_loops_end_with_the_command(tmp_path: Path) -> None:
    done = run(BOX, "--busy", "2", "--", "sh", "-c", f"ps -o pid=,args= --ppid $PPID >{tmp_path}/loops")
    assert done.returncode == 0, done
    loops = [line.split()[0] for line in (tmp_path / "loops").read_text().splitlines() if "while :" in line]
    assert len(loops) == 2, (tmp_path / "loops").read_text()
    assert not any(Path(f"/proc/{pid}").exists() for pid in loops)


def test_ignored_signals_are_not_inherited() -> None:
    box = [sys.executable, str(BOX), "--", "grep", "SigIgn", "/proc/self/status"]

    def ignore() -> None:
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, signal.SIG_IGN)

    done = subprocess.run(box, capture_output=True, text=True, preexec_fn=ignore, timeout=LIMIT_S, check=True)
    # 32 and 33 are the C library's own (signal(7)); env(1) cannot change them.
    ignored = int(done.stdout.split()[1], 16) & ~(1 << 31 | 1 << 32)
    assert ignored == 0, done.stdout


def test_small_limits_hold() -> None:
    done = run(BOX, "--nofile", "64", "--", "sh", "-c", "ulimit -n; ulimit -Hn")
    assert done.stdout.split() == ["64", "64"]
    done = run(BOX, "--shm", "32", "--", "sh", "-c", "df --output=size --block-size=1M /dev/shm; id -u")
    assert done.stdout.split() == ["1M-blocks", "32", str(os.getuid())], done


def test_a_hanging_python_test_fails_and_its_children_die(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text("from limits import *\n")
    (tmp_path / "test_hangs.py").write_text(
        textwrap.dedent(f"""
        import subprocess

        def test_hangs():
            ignores = "trap '' INT TERM; echo $$ >{tmp_path}/pid; while :; do sleep 1; done"
            with subprocess.Popen(["setsid", "sh", "-c", ignores]) as process:
                process.wait()

        def test_the_next_one_runs():
            pass
        """)
    )
    limits = {"DEPTHRIG_TEST_LIMIT_S": "2", "PYTHONPATH": str(PYTHON_TESTS)}
    done = run("-m", "pytest", "-p", "no:cacheprovider", tmp_path, **limits)
    assert done.returncode == 1, done.stdout
    assert "1 failed, 1 passed" in done.stdout
    assert "ran past its limit of 2 s" in done.stdout
    assert not alive(tmp_path / "pid")


LIBTEST = """#!/bin/sh
if [ "$1" = --list ]; then echo "a: test"; echo "hangs: test"; exit; fi
%s
"""


def fake(tmp_path: Path, script: str) -> Path:
    """A test executable that prints what libtest would, and cargo's message about it."""
    path = tmp_path / "fake"
    path.write_text(LIBTEST % script)
    path.chmod(0o755)
    message = {
        "reason": "compiler-artifact",
        "executable": str(path),
        "profile": {"test": True},
        "manifest_path": str(tmp_path / "Cargo.toml"),
        "package_id": f"path+file://{tmp_path}#fake@0.1.0",
        "target": {"name": "it", "kind": ["test"]},
    }
    messages = tmp_path / "messages"
    messages.write_text(json.dumps(message) + "\n")
    return messages


def test_a_hanging_rust_test_is_named(tmp_path: Path) -> None:
    messages = fake(tmp_path, f'echo "test a ... ok"; setsid sleep 1000 & echo $! >{tmp_path}/pid; sleep 1000')
    done = run(RUST, messages, DEPTHRIG_TEST_LIMIT_S="2")
    assert done.returncode == 1
    assert "killed after 2 s without a result; without a result: hangs" in done.stdout
    assert "1 passed; 1 failed" in done.stdout
    assert not alive(tmp_path / "pid")


def test_a_rust_test_that_takes_the_others_with_it_is_a_failure(tmp_path: Path) -> None:
    done = run(RUST, fake(tmp_path, 'echo "test a ... ok"; echo "memory allocation failed"; kill -ABRT $$'))
    assert done.returncode == 1
    assert "died with status 134; without a result: hangs" in done.stdout
    assert "memory allocation failed" in done.stdout


PANICS = r"""
printf 'failures:\n\n---- hangs stdout ----\n\nthread '"'hangs'"' (7) panicked at tests/it.rs:5:9:\n'
printf 'assertion failed: left\n  left: 1\n right: 2\nnote: run with it\n\n'
"""


def test_a_failed_rust_test_is_named_with_its_place_and_message(tmp_path: Path) -> None:
    script = f'echo "test a ... ok"; echo "test hangs ... FAILED"\n{PANICS}\n{ENDED % "FAILED"}; exit 101'
    done = run(RUST, fake(tmp_path, script))
    assert done.returncode == 1
    assert "FAILED fake hangs - tests/it.rs:5: assertion failed: left left: 1 right: 2\n" in done.stdout


ENDED = 'echo "test result: %s. 1 passed; 1 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s"'
NO_DATA = f"""
echo "test a ... ok"; echo "test hangs ... FAILED"
echo "failures:"; echo; echo "---- hangs stdout ----"
echo "/nowhere/x.png: No such file or directory; set DEPTHRIG_TEST_DATA"; echo
echo "failures:"; echo "    hangs"; echo; {ENDED % "FAILED"}; exit 101
"""


@pytest.mark.parametrize("missing", [True, False])
def test_missing_images_are_a_skip_where_they_may_be_missing(tmp_path: Path, missing: bool) -> None:
    skips = tmp_path / "skips"
    more = {"DEPTHRIG_DATA_MISSING": "1"} if missing else {}
    messages = fake(tmp_path, NO_DATA)
    os.environ.pop("DEPTHRIG_DATA_MISSING", None)
    done = run(RUST, messages, DEPTHRIG_TEST_SKIPS=str(skips), **more)
    assert done.returncode == (0 if missing else 1), done.stdout
    assert ("1 passed; 0 failed; 0 ignored; 1 skipped" in done.stdout) == missing
    assert skips.exists() == missing
    if missing:
        assert skips.read_text() == "fake hangs: no real images\n"


def test_a_test_that_says_it_was_skipped_is_not_passed(tmp_path: Path) -> None:
    script = f'echo "test a ... ok"; echo "successes:"; echo; echo "---- a stdout ----"; echo "skipped: no disk"; {ENDED % "ok"}'
    done = run(RUST, fake(tmp_path, script))
    assert done.returncode == 0
    assert "0 passed; 0 failed; 0 ignored; 1 skipped" in done.stdout
    assert "skipped fake a: no disk" in done.stdout


def test_jobs_run_at_once_and_are_all_counted(tmp_path: Path) -> None:
    # Each of two executables waits for a file that the other one writes.
    lines = []
    for mine, other in (("one", "two"), ("two", "one")):
        folder = tmp_path / mine
        folder.mkdir()
        wait = f"touch {tmp_path}/{mine}.there; until [ -e {tmp_path}/{other}.there ]; do sleep 0.1; done"
        lines.append(fake(folder, f'{wait}; echo "test {mine} ... ok"; {ENDED % "ok"}').read_text())
    messages = tmp_path / "messages"
    messages.write_text("".join(lines))
    done = run(RUST, messages, "--jobs", "2", DEPTHRIG_TEST_LIMIT_S="20")
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("test result: ok. 1 passed; 0 failed") == 2
    done = run(RUST, messages, DEPTHRIG_TEST_LIMIT_S="20")
    assert done.returncode == 0, "their files are there now"
