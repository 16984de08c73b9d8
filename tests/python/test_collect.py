"""`depthrig collect`: keys in a real pseudo-terminal, a pedal through a pipe, times alone, and a rig that is killed."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from page import SIMULATED, until
from terminal import LEAVE, Terminal, terminal
from test_daemon import WAIT_S, binary, command, environment, running, runtime

__all__ = ["binary", "runtime"]

TASK = 'put "the cup" on the plate \N{TEACUP WITHOUT HANDLE}'
RIGHT, LEFT, ESCAPE = b"\x1b[C", b"\x1b[D", b"\x1b"
LONG = ("--length", "10m", "--reset", "10m")
CODES = (0, 3)
"""3: intact, but a busy computer may lose a set."""
EV_SYN, EV_KEY = 0, 1


@contextmanager
def rig_runs(binary: str, runtime: Path, folder: Path, name: str, codes: tuple[int, ...] = CODES) -> Iterator[subprocess.Popen[bytes]]:  # noqa: F811
    file = folder / f"{name}.toml"
    file.write_text(f'rig = "{name}"\n[recording]\ndirectory = "datasets"\nreserve_mb = 64\n' + SIMULATED.format(name="cam"))
    with running(binary, runtime, folder / f"{name}.log", "run", str(file), codes=codes) as process:
        until(lambda: "streaming" in command(binary, runtime, "status", "--rig", name, codes=(0, 1, 3)))
        yield process


@pytest.fixture(scope="module")
def daemon(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:  # noqa: F811
    with rig_runs(binary, runtime, tmp_path_factory.mktemp("collect"), "collect"):
        yield "collect"


@pytest.fixture
def rig(daemon: str, binary: str, runtime: Path) -> Iterator[str]:  # noqa: F811
    """A rig that does not record, whatever the test before has left."""
    yield daemon
    command(binary, runtime, "record", "stop", "--rig", daemon, codes=(0, 1, 3))


@contextmanager
def collecting(binary: str, runtime: Path, rig: str, *options: str) -> Iterator[Terminal]:  # noqa: F811
    arguments = ("--rig", rig, "--task", TASK, *options)
    with terminal(binary, runtime, *arguments, columns=200, command="collect") as shown:
        yield shown


def recording(binary: str, runtime: Path, rig: str) -> dict:  # noqa: F811
    return json.loads(command(binary, runtime, "record", "status", "--json", "--rig", rig))


def record_sets(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    """Until two more sets are recorded."""
    before = recording(binary, runtime, rig)["sets"]
    until(lambda: recording(binary, runtime, rig)["sets"] >= before + 2)


def summary(shown: Terminal) -> dict:
    return json.loads(shown.written.rsplit(LEAVE, 1)[1])


def states(binary: str, runtime: Path, dataset: str) -> list[str]:  # noqa: F811
    episodes = json.loads(command(binary, runtime, "info", dataset, "--json", codes=CODES))["episodes"]
    return ["discarded" if e.get("discarded") else e.get("outcome", "kept" if "end_utc_ns" in e else "open") for e in episodes]


def test_three_demonstrations_with_keys(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    with collecting(binary, runtime, rig, "--episodes", "3", *LONG, "--scene", "kitchen", "--json") as shown:
        shown.wait_for("1 of 3 episodes", "RESET", " s left", "0 kept, 0 discarded", "s: success")
        assert re.search(r"\b(600|5\d\d) s left", "\n".join(shown.screen().display))
        # No key, though there are letters in them.
        shown.type(b"\x1b_Gi=31;n\x1b\\\x1b[?62;4;22c\x1bOPx")
        shown.type(LEFT)
        shown.type(RIGHT)
        shown.wait_for("EPISODE, ")
        record_sets(binary, runtime, rig)
        shown.type(b"f")
        shown.wait_for("EPISODE, failure,")
        shown.type(b"s")
        shown.wait_for("EPISODE, success,")
        shown.type(b"n")
        shown.wait_for("RESET", "1 kept, 0 discarded", "last: episode 1: success", "2 of 3 episodes")
        shown.type(b" ")
        shown.wait_for("EPISODE, ")
        shown.type(LEFT)
        shown.wait_for("RESET", "1 kept, 1 discarded", "last: episode 2: discarded")
        shown.type(b"n")
        shown.wait_for("EPISODE, ")
        shown.type(RIGHT)
        shown.wait_for("RESET", "2 kept, 1 discarded")
        shown.type(b"f")
        shown.wait_for("last: episode 3: failure")
        shown.type(b"r")
        shown.wait_for("1 kept, 2 discarded", "last: episode 3: discarded", "2 of 3 episodes")
        for episode in (4, 5):
            shown.type(b"n")
            shown.wait_for("EPISODE, ")
            record_sets(binary, runtime, rig)
            shown.type(b"n")
            if episode == 4:
                shown.wait_for("RESET", "2 kept, 2 discarded", "3 of 3 episodes")
        assert shown.ends() in CODES
        said = summary(shown)
        # At the begin and the end of each.
        assert shown.written.count(b"\x07") == 10
    assert [said[name] for name in ("wanted", "kept", "discarded", "success", "failure", "cut_off")] == [3, 3, 2, 1, 0, 0]
    assert said["error"] is None and not said["recording_goes_on"]
    assert not recording(binary, runtime, rig)["active"]
    assert states(binary, runtime, said["dataset"]) == ["success", "discarded", "discarded", "kept", "kept"]
    info = json.loads(command(binary, runtime, "info", said["dataset"], "--json", codes=CODES))
    assert info["scene"] == "kitchen"
    assert info["episodes"] == said["episodes"]
    assert {e["task"] for e in info["episodes"]} == {TASK}
    lengths = [e["end_utc_ns"] - e["start_utc_ns"] for e in info["episodes"] if not e.get("discarded")]
    assert said["seconds"] == pytest.approx(sum(lengths) / 1e9)


def test_a_recording_that_goes_on_is_joined_and_an_end_from_elsewhere_counts(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    command(binary, runtime, "record", "start", "--name", "joined", "--rig", rig)
    with collecting(binary, runtime, rig, *LONG, "--scene", "other") as shown:
        shown.wait_for("RESET", "joins the recording", "--scene and --operator are not used")
        shown.type(b"n")
        shown.wait_for("EPISODE, ")
        other = ["--task", "second", "--rig", rig]
        refused = subprocess.run([binary, "collect", *other], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S)
        assert refused.returncode == 1 and "episode 1 is running" in refused.stderr
        command(binary, runtime, "episode", "stop", "success", "--rig", rig)
        shown.wait_for("RESET", "1 kept, 0 discarded", "episode 1 was ended by somebody else")
        shown.type(b"n")
        shown.wait_for("EPISODE, ")
        shown.type(ESCAPE)
        assert shown.ends() in CODES
        said = shown.written.rsplit(LEAVE, 1)[1].decode()
    assert "1 of 50 episodes kept" in said and "1 success, 0 failure; 1 discarded" in said and "recording goes on" in said
    assert recording(binary, runtime, rig)["active"]
    stopped = json.loads(command(binary, runtime, "record", "stop", "--json", "--rig", rig, codes=CODES))
    assert states(binary, runtime, stopped["path"]) == ["success", "discarded"]


def test_without_a_terminal_times_alone_decide(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    times = ["--length", "1s", "--reset", "0.5s", "--episodes", "2"]
    done = subprocess.run(
        [binary, "collect", "--rig", rig, "--task", TASK, *times],
        env=environment(runtime), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=WAIT_S, check=False,
    )  # fmt: skip
    assert done.returncode in CODES, done.stderr
    for line in ("no keys", "episode 1 begins: 1 of 2", "episode 1: kept", "episode 2 begins: 2 of 2", "episode 2: kept"):
        assert line in done.stderr
    assert "2 of 2 episodes kept" in done.stdout and "\x1b" not in done.stdout + done.stderr and "\x07" not in done.stderr
    dataset = recording(binary, runtime, rig)
    assert not dataset["active"] and dataset["path"] in done.stdout
    episodes = json.loads(command(binary, runtime, "info", dataset["path"], "--json", codes=CODES))["episodes"]
    assert all(e["end_utc_ns"] - e["start_utc_ns"] >= 0.99e9 for e in episodes)
    assert episodes[1]["start_utc_ns"] - episodes[0]["end_utc_ns"] >= 0.49e9


@pytest.mark.parametrize("ask", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_as_escape_does(binary: str, runtime: Path, rig: str, ask: signal.Signals) -> None:  # noqa: F811
    process = subprocess.Popen(
        [binary, "collect", "--rig", rig, "--task", TASK, "--length", "10m", "--reset", "0.1s", "--json"],
        env=environment(runtime), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stderr is not None
        assert any("episode 1 begins" in line for line in process.stderr)
        process.send_signal(ask)
        out, _ = process.communicate(timeout=WAIT_S)
    said = json.loads(out)
    assert process.returncode in CODES and (said["kept"], said["discarded"], said["cut_off"]) == (0, 1, 0)
    assert states(binary, runtime, said["dataset"]) == ["discarded"]


def key(code: int, value: int, at_s: float) -> bytes:
    """A key's event, and the report that ends it."""
    seconds, micros = int(at_s), round(at_s % 1 * 1e6)
    return struct.pack("qqHHi", seconds, micros, EV_KEY, code, value) + struct.pack("qqHHi", seconds, micros, EV_SYN, 0, 0)


def test_a_pedal_ends_and_repeats_until_it_is_unplugged(binary: str, runtime: Path, rig: str, tmp_path: Path) -> None:  # noqa: F811
    fifo = tmp_path / "pedal"
    os.mkfifo(fifo)
    pedal = os.open(fifo, os.O_RDWR)

    def step(code: int, length_s: float) -> None:
        os.write(pedal, key(code, 1, 10.0) + key(code, 2, 10.01) + key(code, 0, 10.0 + length_s))

    with collecting(binary, runtime, rig, "--episodes", "2", *LONG, "--pedal", str(fifo), "--json") as shown:
        shown.wait_for("RESET", "0 kept, 0 discarded")
        step(48, 0.2)
        shown.wait_for("EPISODE, ")
        step(48, 0.2)
        shown.wait_for("RESET", "1 kept, 0 discarded")
        step(30, 0.2)
        shown.wait_for("RESET", "0 kept, 1 discarded")
        step(48, 0.2)
        shown.wait_for("EPISODE, ")
        step(48, 1.5)
        shown.wait_for("RESET", "0 kept, 2 discarded")
        # Held, and not released yet.
        step(48, 0.2)
        shown.wait_for("EPISODE, ")
        os.write(pedal, key(48, 1, 30.0))
        shown.wait_for("RESET", "0 kept, 3 discarded")
        os.close(pedal)
        shown.wait_for("- pedal", "is gone")
        for kept in (1, 2):
            shown.type(b"n")
            shown.wait_for("EPISODE, ")
            shown.type(b"n")
            if kept == 1:
                shown.wait_for("RESET", "1 kept, 3 discarded")
        assert shown.ends() in CODES
        said = summary(shown)
    assert (said["kept"], said["discarded"]) == (2, 3)


def test_a_pedal_that_is_none_is_refused_before_anything_is_recorded(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    before = command(binary, runtime, "status", "--json", "--rig", rig, codes=CODES)
    for path, why in (("/dev/input/by-id/none", "ls /dev/input/by-id"), ("/dev/null", "not an input device")):
        done = subprocess.run(
            [binary, "collect", "--rig", rig, "--task", TASK, "--pedal", path],
            env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 1 and why in done.stderr and path in done.stderr
    after = command(binary, runtime, "status", "--json", "--rig", rig, codes=CODES)
    paths = [(json.loads(text)["recording"] or {}).get("path") for text in (before, after)]
    assert paths[0] == paths[1]


def test_a_rig_that_is_killed_in_an_episode_is_reported_with_what_was_kept(
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    with (
        rig_runs(binary, runtime, tmp_path, "killed", codes=(-signal.SIGKILL,)) as daemon,
        collecting(binary, runtime, "killed", *LONG, "--json") as shown,
    ):
        shown.wait_for("RESET")
        for _ in range(2):
            shown.type(b"n")
            shown.wait_for("EPISODE, ")
            record_sets(binary, runtime, "killed")
            shown.type(b"n")
            shown.wait_for("RESET")
        shown.type(b"n")
        shown.wait_for("EPISODE, ")
        # The recorder writes what it knows of episodes within a second.
        record_sets(binary, runtime, "killed")
        time.sleep(2)
        daemon.kill()
        daemon.wait(WAIT_S)
        assert shown.ends() == 1
        said, error = shown.written.rsplit(LEAVE, 1)[1].decode().split("depthrig: error: ")
    said = json.loads(said)
    assert (said["kept"], said["discarded"], said["cut_off"]) == (2, 0, 1)
    assert "killed" in said["error"] and "killed" in error
    command(binary, runtime, "recover", said["dataset"], codes=CODES)
    assert states(binary, runtime, said["dataset"]) == ["kept", "kept", "open"]


def test_a_recording_that_is_ended_elsewhere_ends_the_session(binary: str, runtime: Path, rig: str) -> None:  # noqa: F811
    with collecting(binary, runtime, rig, *LONG) as shown:
        shown.wait_for("RESET")
        shown.type(b"n")
        shown.wait_for("EPISODE, ")
        command(binary, runtime, "record", "stop", "--rig", rig, codes=CODES)
        assert shown.ends() == 1
        said = shown.written.rsplit(LEAVE, 1)[1].decode()
    assert "0 of 50 episodes kept" in said and "episode 1 was cut off" in said and "--episode 1=discard" in said
    assert "was ended by somebody else" in said
