"""The live page of a rig of two computers: cameras of the other one are on the wall, and what they lack is named."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from page import CHROMIUM, FAR, MIDDLE, NEAR, PATCHES, RIG, address, blank, files_camera, free_port, pattern, until
from playwright.sync_api import Browser
from test_daemon import binary, running, runtime
from test_page import CODES, browser, millimetres, save_screenshot, wait_for_colors

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

STREAMS = ["wrist/color", "wrist/depth"]
HERE = """[link]
host = "right"
listen = "127.0.0.1:{port}"
[[link.hosts]]
name = "left"
socket = {socket}
mirror = ["wrist/color", "wrist/depth", "later/color"]
"""
THERE = """[link]
host = "left"
recorder = "127.0.0.1:{port}"
"""


@pytest.fixture
def other() -> Iterator[Path]:
    """The runtime directory of the other computer."""
    with tempfile.TemporaryDirectory(prefix="rig") as folder:
        yield Path(folder)


def test_cameras_of_another_computer_are_on_the_wall(
    browser: Browser,  # noqa: F811
    binary: str,  # noqa: F811
    runtime: Path,  # noqa: F811
    other: Path,
    tmp_path: Path,
) -> None:
    port = free_port()
    here, there = tmp_path / "here.toml", tmp_path / "there.toml"
    link = HERE.format(port=port, socket=f'"{other}/mount.sock"')
    here.write_text(RIG.format(name="mount", port=free_port()) + link + files_camera("still", pattern(tmp_path / "still")))
    control = RIG.format(name="mount", port=free_port()).replace('"datasets"', '"parts"')
    there.write_text(control + THERE.format(port=port) + files_camera("wrist", pattern(tmp_path / "wrist")))
    with running(binary, runtime, tmp_path / "here.log", "run", str(here), codes=CODES), blank(browser, "") as wall:
        wall.open(address(binary, runtime, "mount").text)
        wall.wait_for_image("still/color")
        # A computer that was never there is named where its cameras will be.
        why = "([t, why]) => document.querySelector(`${t} .message`).innerText.includes(why)"
        wrist = 'section.tile[data-camera="wrist"]'
        wall.wait_for(why, wrist, "host left: ")
        assert wall.state(wrist) == "waiting"
        with running(binary, other, tmp_path / "there.log", "run", str(there), codes=CODES) as daemon:
            wall.wait_for_image(*STREAMS)
            wait_for_colors(wall, "wrist/color", *PATCHES)
            for patch in (NEAR, MIDDLE, FAR):
                wall.hover("wrist/depth", patch)
                until(lambda at=patch: abs((millimetres(wall.hovered()) or 0) - at.depth_mm) <= 1, wall.hovered)
            # One that the other computer does not have waits for it, and harms no other.
            later = 'section.tile[data-camera="later"]'
            assert wall.state(later) == "waiting"
            wall.wait_for(why, later, "nobody publishes it there")
            assert "NaN" not in wall.page.inner_text("#cameras")
            wall.wait_for_state('section.tile[data-stream="wrist/color"]', "live")
            save_screenshot(wall, "hosts")

            os.kill(daemon.pid, signal.SIGKILL)
            tile = 'section.tile[data-stream="wrist/color"]'
            wall.wait_for_state(tile, "stale")
            wall.wait_for(why, tile, "host left: ")
            wall.wait_for_state('section.tile[data-stream="still/color"]', "live")
            save_screenshot(wall, "hosts-absent")
        with running(binary, other, tmp_path / "there.log", "run", str(there), codes=CODES):
            wall.wait_for_state(tile, "live")
