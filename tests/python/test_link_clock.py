"""The clock between two hosts, against truth: two namespaces of one computer, and a proxy whose clock drifts and steps."""

from __future__ import annotations

import random
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from test_daemon import binary  # noqa: F401

ROOT = Path(__file__).parents[2]
HOSTS = ROOT / "tests/link/two_hosts.py"
SHIFT_NS = 1_234_567_890_123


@dataclass(frozen=True)
class Reading:
    local_ns: int
    offset_ns: int
    uncertainty_ns: int
    epoch: int


def readings(output: str) -> list[Reading]:
    rows = [line.split() for line in output.splitlines() if line[:1].isdigit() and len(line.split()) == 6]
    return [Reading(*map(int, row[:4])) for row in rows]


@pytest.fixture(scope="module")
def clocks(binary: str) -> str:  # noqa: F811
    return str(Path(binary).parent / "examples" / "two_clocks")


def namespaces() -> None:
    """Skip where an ordinary user gets no namespaces."""
    tried = subprocess.run(["unshare", "-UrnT", "true"], capture_output=True, text=True, check=False)
    if tried.returncode != 0:
        pytest.skip(f"this computer gives an ordinary user no namespaces: {tried.stderr.strip()}")


@pytest.mark.parametrize("load", [[], ["--load"]], ids=["idle", "saturated"])
def test_the_offset_of_another_host_is_within_its_uncertainty(clocks: str, load: list[str]) -> None:
    namespaces()
    there = [clocks, "answer", "10.77.0.2:7447"]
    here = [clocks, "ask", "10.77.0.2:7447", "12"]
    command = ["unshare", "-Urn", sys.executable, str(HOSTS), "--shift", str(SHIFT_NS), *load, *there, "--", *here]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr
    got = readings(done.stdout)
    assert len(got) > 500, done.stdout[-1000:] + done.stderr
    # Both namespaces are one computer: the clocks are exactly so far apart.
    wrong = [r for r in got if abs(r.offset_ns - SHIFT_NS) > r.uncertainty_ns]
    assert wrong == []
    assert {r.epoch for r in got} == {1}


@dataclass
class OtherClock:
    """Forwards questions and answers late, and makes the answering clock one that drifts and steps."""

    answerer: tuple[str, int]
    rate: float
    offset_ns: int
    begin_ns: int = field(default_factory=time.monotonic_ns)
    step_at_ns: int = 1 << 62
    step_ns: int = 0
    stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.front = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.front.bind(("127.0.0.1", 0))
        self.front.settimeout(0.1)
        self.back = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.back.connect(self.answerer)
        self.back.settimeout(1.0)

    def offset_at(self, local_ns: int) -> float:
        stepped = self.step_ns if local_ns >= self.step_at_ns else 0
        return self.offset_ns + self.rate * (local_ns - self.begin_ns) + stepped

    def run(self) -> None:
        chance = random.Random(7)
        while not self.stop.is_set():
            try:
                question, asker = self.front.recvfrom(100)
                time.sleep(chance.choice([0.0, 0.0, 0.001, 0.003]))
                self.back.send(question)
                answer = bytearray(self.back.recv(100))
            except TimeoutError:
                continue
            for at in (40, 48):
                (stamp,) = struct.unpack_from("<q", answer, at)
                struct.pack_into("<q", answer, at, stamp + round(self.offset_at(stamp)))
            time.sleep(chance.choice([0.0, 0.0, 0.001, 0.003]))
            self.front.sendto(answer, asker)


@pytest.mark.parametrize("rate", [100e-6, -100e-6, 0.0])
def test_a_clock_that_drifts_and_steps(clocks: str, rate: float) -> None:
    with subprocess.Popen([clocks, "answer", "127.0.0.1:0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as answerer:
        assert answerer.stdout is not None
        host, port = answerer.stdout.readline().strip().split(":")
        other = OtherClock((host, int(port)), rate, 86_400_000_000_123)
        other.step_at_ns, other.step_ns = other.begin_ns + 6_000_000_000, 100_000_000
        thread = threading.Thread(target=other.run)
        thread.start()
        try:
            address = "{}:{}".format(*other.front.getsockname())
            asked = subprocess.run([clocks, "ask", address, "12"], capture_output=True, text=True, timeout=120, check=True)
        finally:
            other.stop.set()
            thread.join()
            answerer.communicate()
    got = readings(asked.stdout)
    assert {r.epoch for r in got} == {1, 2}, asked.stdout[-1000:]
    first_of_2 = next(r.local_ns for r in got if r.epoch == 2)
    assert first_of_2 > other.step_at_ns
    for r in got:
        if r.epoch == 2 or r.local_ns < other.step_at_ns:
            error = abs(r.offset_ns - other.offset_at(r.local_ns))
            assert error <= r.uncertainty_ns + 1, (error, r)
    # The steadily drifting clock is known to less than the delays of its answers.
    assert min(r.uncertainty_ns for r in got) < 2_000_000
