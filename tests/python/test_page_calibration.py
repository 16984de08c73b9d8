"""The calibration's map of uncertainty in its panel: the numbers of the file that the rig uses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from page import CHROMIUM, RIG, SIMULATED, Address, Wall, address, free_port, opened, until
from playwright.sync_api import Browser
from test_daemon import binary, running, runtime
from test_page import AXE, CODES, browser, save_screenshot, violations
from test_page_panels import ask, open_panel, wait_for_text

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

HEAD = """format = "depthrig.calibration/1"
created = "2026-11-25T03:00:00Z"
reference = "front"
rms_px = 0.2
[board]
pattern = "chessboard"
columns = 10
rows = 7
square_mm = 25.0
"""
CAMERA = """
[[camera]]
name = "{name}"
stream = "color"
width = 320
height = 240
source = "calibrated"
intrinsics = {{ model = "none", fx = 400.0, fy = 400.0, cx = 159.5, cy = 119.5 }}
pose = {{ translation_m = [{x}, 0.0, 0.0], rotation_xyzw = [0.0, 0.0, 0.0, 1.0], sigma_mm = 0.1, sigma_deg = 0.01 }}
quality = {{ views = 20, corners = 1000, rms_px = 0.2, projection_middle_px = 0.1, projection_worst_px = 1.5 }}
"""
COLUMNS = 4
SIGMA_PX = [0.5, 0.25, 0.25, 1.5, 0.5, 0.2, 0.1, 0.5, 0.0, 0.25, 0.25, float("nan")]
MAP = f"uncertainty = {{ distance_m = 0.8, columns = {COLUMNS}, sigma_px = {SIGMA_PX} }}\n"


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("calibrated")
    entries = CAMERA.format(name="front", x=0.0) + MAP + CAMERA.format(name="left", x=0.2)
    (folder / "calibration.toml").write_text(HEAD + entries)
    named = 'calibration = "calibration.toml"\n[control]'
    head = RIG.format(name="calibrated", port=free_port()).replace("[control]", named)
    (folder / "calibrated.toml").write_text(head + SIMULATED.format(name="front") + SIMULATED.format(name="left"))
    with running(binary, runtime, folder / "calibrated.log", "run", str(folder / "calibrated.toml"), codes=CODES):
        yield address(binary, runtime, "calibrated")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image("front/color", "left/color")
        yield wall


# The hue and the lightness of each cell's middle, as CSS has them.
CELLS = """([columns, rows]) => {
    const canvas = document.querySelector(".uncertainty canvas");
    const context = canvas.getContext("2d");
    return Array.from({ length: columns * rows }, (_, i) => {
        const x = ((i % columns) + 0.5) / columns * canvas.width;
        const y = (Math.floor(i / columns) + 0.5) / rows * canvas.height;
        return [...context.getImageData(x, y, 1, 1).data.slice(0, 3)];
    });
}"""


def test_the_map_of_the_file_is_shown_and_a_file_without_one_says_so(wall: Wall, rig: Address) -> None:
    front, left = ask(rig, "GET", "/v1/calibration")
    assert (front["stream"], front["uncertainty"]["columns"]) == ("front/color", COLUMNS)
    assert front["uncertainty"]["sigma_px"] == [*SIGMA_PX[:-1], None]
    assert front["uncertainty"]["pixel_mm"] == pytest.approx(2.0)
    assert (left["stream"], left["uncertainty"]) == ("left/color", None)
    panel = open_panel(wall, "k", "Calibration")
    wait_for_text(panel, "left/color: the calibration's file has no map of uncertainty")
    text = panel.locator(".uncertainty figcaption").inner_text()
    assert "at 0.80 m" in text
    assert "0.10 px (0.20 mm) in the middle, at most 1.50 px (3.00 mm)" in text
    assert panel.locator(".uncertainty canvas").get_attribute("aria-label") == text
    cells = wall.page.evaluate(CELLS, [COLUMNS, len(SIGMA_PX) // COLUMNS])

    def red_over_green(sigma: float) -> float:
        red, green, _ = cells[SIGMA_PX.index(sigma)]
        return float(red) - float(green)

    # From green over yellow to red; grey where the lens shows nothing.
    scale = [red_over_green(s) for s in (0.0, 0.25, 0.5, 1.5)]
    assert scale == sorted(scale)
    assert red_over_green(0.0) < -80
    assert red_over_green(1.5) > 80
    assert cells[-1] == [136, 136, 136]
    save_screenshot(wall, "calibration")
    if AXE.exists():
        wall.page.evaluate(AXE.read_text() + "; undefined")
        assert violations(wall, "calibration") == []


def test_the_panel_is_shown_without_the_maps(wall: Wall) -> None:
    def refuse(route: Any) -> None:
        route.fulfill(status=500, body="")

    wall.page.route("**/v1/calibration", refuse)
    panel = open_panel(wall, "k", "Calibration")
    wait_for_text(panel, "The map of uncertainty was not read")
    until(lambda: panel.locator(".finding").count() == 2)
