"""An enlarged image against another one: a reference of before, and raw against refined depth."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page import (
    CHROMIUM,
    FAR,
    HEIGHT,
    HOLE,
    MANIFEST,
    MIDDLE,
    NEAR,
    RIG,
    STREAM,
    WIDTH,
    Address,
    Wall,
    address,
    files_camera,
    free_port,
    opened,
    pattern,
    until,
)
from PIL import Image
from playwright.sync_api import Browser
from test_daemon import binary, running, runtime
from test_page import AXE, CODES, browser, save_screenshot, set_range, violations

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

REFINE = '[camera.refine]\nengine = "fill"\nfill_reach = 1.0\nrate_hz = 0\ncorrected = true\n'
# Refined depth of NEAR is what raw depth of MIDDLE is.
CORRECTION = f"""format = "depthrig.calibration/1"
created = "2026-11-25T03:00:00Z"
reference = ""
rms_px = 0.0
camera = []
[board]
pattern = "chessboard"
columns = 10
rows = 7
square_mm = 25.0
[[depth]]
camera = "still"
stream = "depth"
width = {WIDTH}
height = {HEIGHT}
created = "2026-11-25T03:00:00Z"
model = "scale_offset"
scale = 2.0
offset_mm = {MIDDLE.depth_mm - 2 * NEAR.depth_mm}.0
"""
RAW = "still/depth"
REFINED = "still/depth_refined"
GREY = 12
"""Most that the channels of a grey differ."""


def texture(dx: float = 0.0, dy: float = 0.0) -> np.ndarray:
    """A scene of 1/f, moved by parts of a pixel, as its spectrum is; beyond a border it repeats."""
    random = np.random.default_rng(5)
    fy = np.fft.fftfreq(2 * HEIGHT)[:, None]
    fx = np.fft.fftfreq(2 * WIDTH)[None, :]
    spectrum = np.fft.fft2(random.standard_normal((2 * HEIGHT, 2 * WIDTH))) / (np.hypot(fx, fy) + 0.01)
    moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (fx * dx + fy * dy))).real
    return np.clip(128 + 40 * moved / moved.std(), 0, 255).astype(np.uint8)[:HEIGHT, :WIDTH]


def textured(folder: Path, image: np.ndarray) -> Path:
    folder.mkdir()
    Image.fromarray(np.repeat(image[..., None], 3, axis=2)).save(folder / "color_1.png")
    manifest = folder / "camera.toml"
    manifest.write_text(MANIFEST + STREAM.format(name="color", more=""))
    return manifest


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("compare")
    cameras = files_camera("still", pattern(folder / "still")) + REFINE
    cameras += files_camera("table", textured(folder / "table", texture()))
    cameras += files_camera("fog", textured(folder / "fog", np.full((HEIGHT, WIDTH), 128, np.uint8)))
    (folder / "calibration.toml").write_text(CORRECTION)
    text = 'calibration = "calibration.toml"\n' + RIG.format(name="compare", port=free_port()) + cameras
    (folder / "compare.toml").write_text(text)
    with running(binary, runtime, folder / "compare.log", "run", str(folder / "compare.toml"), codes=CODES):
        yield address(binary, runtime, "compare")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image("still/color", RAW, REFINED, "table/color", "fog/color")
        yield wall


def enlarge(wall: Wall, stream: str) -> None:
    wall.tile(stream).focus()
    wall.page.keyboard.press("Enter")
    wall.page.wait_for_selector(f'.tile.enlarged[data-stream="{stream}"]')


def facts(wall: Wall) -> dict[str, Any]:
    return wall.page.evaluate("depthrig.reference.facts")


def shift(wall: Wall) -> dict[str, Any]:
    return until(lambda: facts(wall)["shift"])


def said(wall: Wall) -> str:
    return wall.page.inner_text("#reference strong")


def test_the_present_image_is_kept_and_survives_the_wall_and_a_reload(wall: Wall) -> None:
    enlarge(wall, "table/color")
    wall.page.keyboard.press("o")
    wall.page.wait_for_selector("canvas.reference")
    found = shift(wall)
    assert (found["certainty"], abs(found["dx"]) < 0.1, abs(found["dy"]) < 0.1) == ("sure", True, True), found
    assert wall.state("#reference strong") == "still"
    kept = facts(wall)["at"]
    wall.page.keyboard.press("Escape")
    assert not wall.page.locator("#reference").is_visible()
    assert wall.page.locator("canvas.reference").count() == 0
    enlarge(wall, "table/color")
    wall.page.wait_for_selector("canvas.reference")
    wall.page.reload()
    wall.wait_for_image("table/color")
    enlarge(wall, "table/color")
    assert not wall.page.locator("#reference").is_visible()
    wall.page.keyboard.press("o")
    wall.page.wait_for_selector("canvas.reference")
    assert facts(wall)["at"] == kept
    wall.page.get_by_text("Keep the present image").click()
    until(lambda: facts(wall)["at"] > kept)
    wall.page.keyboard.press("o")
    until(lambda: wall.page.locator("canvas.reference").count() == 0)


def keep_in_the_page(wall: Wall, stream: str, image: np.ndarray) -> None:
    """Puts an image where the page keeps the reference of a stream."""
    packed = io.BytesIO()
    Image.fromarray(np.repeat(image[..., None], 3, axis=2)).save(packed, "JPEG", quality=90)
    text = base64.b64encode(packed.getvalue()).decode()
    kept = {"fullColumns": WIDTH, "fullRows": HEIGHT, "at": 1000, "text": text}
    wall.page.evaluate("([k, v]) => sessionStorage.setItem(k, v)", [f"depthrig-reference:{stream}", json.dumps(kept)])


@pytest.mark.parametrize(("dx", "dy"), [(0.6, -0.3), (-7.25, 12.5)])
def test_a_camera_that_has_moved_says_how_far(wall: Wall, dx: float, dy: float) -> None:
    # The camera sees what the reference shows, moved by (dx, dy).
    keep_in_the_page(wall, "table/color", texture(-dx, -dy))
    enlarge(wall, "table/color")
    wall.page.keyboard.press("o")
    wall.page.wait_for_selector("canvas.reference")
    found = shift(wall)
    assert found["certainty"] == "sure"
    assert (found["dx"], found["dy"]) == pytest.approx((dx, dy), abs=0.1)
    assert wall.state("#reference strong") == "moved"
    assert "(sure)" in said(wall)
    save_screenshot(wall, "reference")


def test_without_texture_no_shift_is_claimed(wall: Wall) -> None:
    enlarge(wall, "fog/color")
    wall.page.keyboard.press("o")
    until(lambda: said(wall).startswith("No shift found"), lambda: said(wall))
    assert wall.state("#reference strong") == "unknown"


def test_the_difference_of_equal_images_is_black(wall: Wall) -> None:
    enlarge(wall, "still/color")
    wall.page.keyboard.press("o")
    wall.page.wait_for_selector("canvas.reference")
    until(lambda: max(wall.colors("still/color", NEAR)[0]) > 80)
    wall.page.select_option("#reference select", "difference")
    until(lambda: max(max(color) for color in wall.colors("still/color", NEAR, FAR, MIDDLE)) < 3 * GREY)


def test_depth_has_no_reference(wall: Wall) -> None:
    enlarge(wall, RAW)
    assert not wall.page.locator("#show-reference").is_visible()
    wall.page.keyboard.press("o")
    until(lambda: "colour and infrared" in wall.page.inner_text("#problem"))


def test_raw_depth_is_left_of_the_line_and_refined_depth_right(wall: Wall) -> None:
    set_range(wall, 0.5, 8.0)
    enlarge(wall, RAW)
    wall.page.wait_for_selector("#wipe-box", state="visible")
    patches = (NEAR, MIDDLE, FAR, HOLE)

    def differ(a: list[tuple[int, int, int]], b: list[tuple[int, int, int]]) -> list[bool]:
        return [max(abs(x - y) for x, y in zip(*pair)) > GREY for pair in zip(a, b)]

    def settled() -> list[tuple[int, int, int]]:
        """The colours, as soon as two looks agree. An image that is late is grey."""
        tile = f'section.tile[data-stream="{RAW}"]'
        colors: list[list[tuple[int, int, int]]] = [[], wall.colors(RAW, *patches)]

        def is_settled() -> bool:
            was_live = wall.state(tile) == "live"
            colors[:] = [colors[1], wall.colors(RAW, *patches)]
            return was_live and colors[0] == colors[1] and wall.state(tile) == "live"

        until(is_settled, lambda: colors)
        return colors[1]

    raw = settled()
    wall.page.fill("#wipe", "0")
    until(lambda: all(differ(wall.colors(RAW, *patches), raw)), lambda: wall.colors(RAW, *patches))
    refined = settled()
    # One range of colours: equal depths look equal, whichever side they are on.
    assert differ([refined[0]], [raw[1]]) == [False]
    # NEAR and MIDDLE lie at a quarter of the width, FAR and HOLE at three quarters.
    for line, wanted in ((20, refined), (30, [*raw[:2], *refined[2:]]), (70, [*raw[:2], *refined[2:]]), (80, raw)):
        wall.page.fill("#wipe", str(line))
        until(
            lambda wanted=wanted: not any(differ(wall.colors(RAW, *patches), wanted)),
            lambda: (line, wall.colors(RAW, *patches), wanted),
        )
    # Refined depth, enlarged, begins with itself alone.
    wall.page.keyboard.press("Escape")
    enlarge(wall, REFINED)
    wall.page.wait_for_selector("#wipe-box", state="visible")
    assert wall.page.input_value("#wipe") == "0"
    until(lambda: not any(differ(wall.colors(REFINED, *patches), refined)), lambda: wall.colors(REFINED, *patches))


def test_the_line_is_dragged_and_moved_by_keys(wall: Wall) -> None:
    enlarge(wall, RAW)
    wall.page.wait_for_selector(".wipe-line")
    wall.focus_by_keyboard("#wipe")
    wall.page.keyboard.press("ArrowLeft")
    assert wall.page.input_value("#wipe") == "99"
    line = wall.page.locator(".wipe-line").bounding_box()
    assert line is not None
    wall.page.fill("#wipe", "100")
    right, y = wall.place(RAW, type(NEAR)(1.0, 0.4, NEAR.color, 0))
    middle, _ = wall.place(RAW, type(NEAR)(0.3, 0.4, NEAR.color, 0))
    wall.page.mouse.move(right - 2, y)
    wall.page.mouse.down()
    wall.page.mouse.move(middle, y, steps=4)
    wall.page.mouse.up()
    assert wall.page.input_value("#wipe") == "30"
    # Nothing else was meant by the drag.
    wall.page.wait_for_selector(f'.tile.enlarged[data-stream="{RAW}"]')
    save_screenshot(wall, "wipe")
    # Blending takes the place of the line, and the other way round.
    wall.page.fill("#blend", "50")
    assert wall.page.input_value("#wipe") == "100"
    wall.page.fill("#wipe", "40")
    assert wall.page.input_value("#blend") == "100"


def test_colour_has_no_line(wall: Wall) -> None:
    enlarge(wall, "still/color")
    wall.page.wait_for_selector("#blend-box", state="visible")
    assert not wall.page.locator("#wipe-box").is_visible()
    assert wall.page.locator(".wipe-line").count() == 0


def test_neither_has_a_serious_violation_of_accessibility(wall: Wall) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not in tests/readers/node_modules; make test puts it there")
    wall.page.evaluate(AXE.read_text() + "; undefined")
    enlarge(wall, "table/color")
    wall.page.keyboard.press("o")
    wall.page.wait_for_selector("canvas.reference")
    shift(wall)
    found = violations(wall, "reference")
    enlarge(wall, RAW)
    wall.page.wait_for_selector("#wipe-box", state="visible")
    wall.page.fill("#wipe", "50")
    assert found + violations(wall, "wipe") == []
