from __future__ import annotations

import gc
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from depthrig._bus import Bus
from limits import *  # noqa: F403
from rig import Publisher, build_publisher


@pytest.fixture(scope="session")
def binary() -> str:
    return build_publisher()


@pytest.fixture
def folder() -> Iterator[Path]:
    """A runtime folder: short, because sockets live below it."""
    path = Path(tempfile.mkdtemp(prefix="rig", dir="/tmp"))
    yield path
    # Killed publishers leave shared memory behind, which can be found only while this folder exists.
    gc.collect()
    Bus.at(str(path)).clean_dead()
    gc.collect()
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture
def live(binary: str, folder: Path) -> Iterator[Path]:
    """A publisher at 100 Hz."""
    process = subprocess.Popen([binary, str(folder), "--fps", "100", "--pad", "2"], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    yield folder
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.fixture
def start(binary: str, folder: Path) -> Iterator[Callable[..., Publisher]]:
    """Starts publishers in `folder`; they are ended with the test."""
    started: list[Publisher] = []

    def start(*options: str, rig: str = "example") -> Publisher:
        started.append(Publisher(binary, folder, *options, rig=rig))
        return started[-1]

    yield start
    for publisher in started:
        publisher.stop()  # a killed one would leave its shared memory behind
