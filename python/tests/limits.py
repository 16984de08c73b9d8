"""For every test: a time limit that kills what the test has started, default signals, and a line in the list of skips.

A time limit that only raises is not enough: an exception inside `with subprocess.Popen(...)` waits for the child, and a
child that ignores the signal it was sent never ends. Its hooks are imported by the `conftest.py` of each folder of tests.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Optional

import pytest

LIMIT_S = float(os.environ.get("DEPTHRIG_TEST_LIMIT_S", "600"))
AGAIN_S = 10.0
"""Raised again after so long, should a test's own cleaning up hang too."""
_before: set[int] = set()
"""Processes that were there before the test."""

__all__ = [
    "pytest_configure",
    "pytest_runtest_call",
    "pytest_runtest_logreport",
    "pytest_runtest_setup",
    "pytest_runtest_teardown",
]


def pytest_configure() -> None:
    """Undoes what `nohup` and a shell's background leave: children would inherit ignored signals and never end."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def descendants() -> set[int]:
    """All processes below this one."""
    children: dict[int, list[int]] = {}
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            with suppress(OSError):
                fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
                children.setdefault(int(fields[1]), []).append(int(entry.name))
    found: set[int] = set()
    todo = [os.getpid()]
    while todo:
        new = children.get(todo.pop(), [])
        found.update(new)
        todo += new
    return found


def _expired(_number: int, _frame: Optional[FrameType]) -> None:
    for pid in descendants() - _before:
        with suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    pytest.fail(f"the test ran past its limit of {LIMIT_S:.0f} s; what it had started was killed")


@contextmanager
def _limit() -> Iterator[None]:
    old = signal.signal(signal.SIGALRM, _expired)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S, AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        # None: a library set it in C, as the OAK SDK does.
        signal.signal(signal.SIGALRM, signal.SIG_DFL if old is None else old)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    """Limits fixtures."""
    _before.clear()
    _before.update(descendants())
    with _limit():
        yield


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Limits the test."""
    with _limit():
        yield


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    """Limits the end of fixtures."""
    with _limit():
        yield


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Names a skipped test in the file of `DEPTHRIG_TEST_SKIPS`."""
    path = os.environ.get("DEPTHRIG_TEST_SKIPS")
    # A process of pytest-xdist reports to another one, which comes here too.
    if report.skipped and path and "PYTEST_XDIST_WORKER" not in os.environ:
        why = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
        with open(path, "a") as file:
            file.write(f"{report.nodeid}: {why}\n")
