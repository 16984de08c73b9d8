"""The aids for setting up, in a real browser, on images whose numbers are known."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page import (
    CHROMIUM,
    HEIGHT,
    MANIFEST,
    PATCHES,
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
from page_scene import FRONT, SIDE
from PIL import Image
from playwright.sync_api import Browser
from test_daemon import binary, running, runtime
from test_page import AXE, CODES, browser, save_screenshot, violations, wait_for_colors

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

STREAMS = ["still/color", "still/depth", "restless/color", "restless/depth", "front/depth", "side/depth"]
BINS = 64
STEP_MM = 2
"""Depth of `restless` jumps between two images that differ by so much."""


def restless(folder: Path) -> Path:
    """A camera whose colour is a quarter white and a quarter black, and whose depth jumps."""
    folder.mkdir()
    color = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    color[:, : WIDTH // 4] = 255
    color[:, -WIDTH // 4 :] = 0
    for i in (1, 2):
        Image.fromarray(color).save(folder / f"color_{i}.png")
        Image.fromarray(np.full((HEIGHT, WIDTH), 1000 + i * STEP_MM, np.uint16)).save(folder / f"depth_{i}.png")
    manifest = folder / "camera.toml"
    depth = STREAM.format(name="depth", more="depth_unit_m = 0.001\n")
    manifest.write_text(MANIFEST + STREAM.format(name="color", more="") + depth)
    return manifest


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("aids")
    cameras = files_camera("still", pattern(folder / "still"))
    cameras += files_camera("restless", restless(folder / "restless"))
    cameras += FRONT.write(folder / "front") + SIDE.write(folder / "side")
    (folder / "aids.toml").write_text(RIG.format(name="aids", port=free_port()) + cameras)
    with running(binary, runtime, folder / "aids.log", "run", str(folder / "aids.toml"), codes=CODES):
        yield address(binary, runtime, "aids")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image(*STREAMS)
        yield wall


def open_aids(wall: Wall, stream: str) -> None:
    wall.tile(stream).focus()
    wall.page.keyboard.press("a")
    wall.page.wait_for_selector("#aids", state="visible")
    assert wall.page.inner_text("#aids-stream") == stream


def facts(wall: Wall) -> dict[str, Any]:
    return wall.page.evaluate("depthrig.aids.facts")


def measure(wall: Wall) -> dict[str, Any]:
    return until(lambda: facts(wall)["measure"])


OVERLAY = """() => {
    const canvas = document.querySelector(".enlarged .overlay");
    const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    return [canvas.width, canvas.height, Array.from(data.filter((_, i) => i % 4 === 3), a => a === 0 ? 0 : 1)];
}"""


def overlay(wall: Wall) -> np.ndarray:
    """Which pixels of the layer over the image are painted."""
    columns, rows, painted = wall.page.evaluate(OVERLAY)
    return np.array(painted, bool).reshape(rows, columns)


def test_the_histogram_peaks_where_the_luma_of_the_image_is(wall: Wall) -> None:
    open_aids(wall, "still/color")
    numbers = measure(wall)
    luma = np.array(numbers["luma"])
    assert luma.sum() == pytest.approx(1)
    for patch in PATCHES:
        level = np.dot(patch.color, (0.299, 0.587, 0.114))
        bin_of_it = int(level / 256 * BINS)
        assert luma[max(0, bin_of_it - 1) : bin_of_it + 2].sum() >= 0.24, f"{patch}: {luma}"
    assert (numbers["dark"], numbers["bright"]) == (0, 0)
    assert wall.page.inner_text("#aids-clipped") == "Black 0.00 %, white 0.00 %"
    assert wall.page.evaluate(HISTOGRAM) > 100
    save_screenshot(wall, "aids-color")


HISTOGRAM = """() => {
    const canvas = document.querySelector("#aids-histogram");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.filter((value, i) => i % 4 === 3 && value > 0).length;
}"""


def test_sharpness_is_shown_with_its_peak_until_that_is_reset(wall: Wall) -> None:
    open_aids(wall, "still/color")
    sharpness = measure(wall)["sharpness"]
    assert sharpness > 0
    until(lambda: wall.page.inner_text("#aids-sharpness") == f"{sharpness:.1f}, peak {sharpness:.1f}")
    assert float(wall.page.evaluate("document.querySelector('#aids-focus').value")) == pytest.approx(1)
    wall.page.click("#aids-reset-peak")
    assert facts(wall)["peak"] == pytest.approx(sharpness)


def test_edges_in_focus_are_marked_and_nothing_else(wall: Wall) -> None:
    open_aids(wall, "still/color")
    wall.page.check("#aids-peaking")
    until(lambda: overlay(wall).any())
    marked = overlay(wall)
    assert marked.shape == (HEIGHT, WIDTH), "an enlarged image is not made smaller"
    rows, columns = np.nonzero(marked)
    from_edge = np.minimum(abs(rows - HEIGHT / 2 + 0.5), abs(columns - WIDTH / 2 + 0.5))
    assert (from_edge < 8).all(), "edges are where the patches meet; JPEG has blocks of 8"
    assert marked.sum() > 100
    wall.page.uncheck("#aids-peaking")
    until(lambda: not overlay(wall).any())


def test_clipped_pixels_are_counted_and_striped(wall: Wall) -> None:
    open_aids(wall, "restless/color")
    numbers = measure(wall)
    assert (numbers["dark"], numbers["bright"]) == (pytest.approx(0.25), pytest.approx(0.25))
    assert wall.page.inner_text("#aids-clipped") == "Black 25.00 %, white 25.00 %"
    wall.page.check("#aids-zebra")
    until(lambda: overlay(wall).any())
    marked = overlay(wall)
    quarter = WIDTH // 4
    for columns in (slice(4, quarter - 8), slice(WIDTH - quarter + 8, WIDTH - 4)):
        assert 0.4 < marked[:, columns].mean() < 0.6
    assert not marked[:, quarter + 8 : -quarter - 8].any()
    save_screenshot(wall, "aids-zebra")


def test_the_share_of_holes_has_the_colour_of_its_meaning_and_a_map(wall: Wall) -> None:
    open_aids(wall, "still/depth")
    until(lambda: facts(wall)["holes"] == 0.25, lambda: facts(wall))
    assert wall.page.inner_text("#aids-filled") == "Filled 75.0 %, holes 25.0 %"
    assert wall.state("#aids-filled") == "fair"
    wall.page.select_option("#aids-map", "holes")
    until(lambda: facts(wall)["noiseMm"] is not None)
    until(lambda: overlay(wall).any())
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[HEIGHT // 2 :, WIDTH // 2 :] = True
    assert (overlay(wall) == expected).all()
    save_screenshot(wall, "aids-holes")


def test_constant_depth_has_no_noise_and_depth_that_jumps_has_its_standard_deviation(wall: Wall) -> None:
    open_aids(wall, "still/depth")
    assert re.search(r"\d+ of 30 images", wall.page.inner_text("#aids-noise"))
    until(lambda: facts(wall)["noiseMm"] is not None)
    assert facts(wall)["noiseMm"] == 0
    wall.tile("restless/depth").focus()
    wall.page.keyboard.press("Enter")
    until(lambda: facts(wall)["stream"] == "restless/depth")
    # Of two values in equal shares it is half their difference; a loaded computer may show one of them more often.
    until(lambda: 0.6 * STEP_MM / 2 < (facts(wall)["noiseMm"] or 0) < 1.05 * STEP_MM / 2, lambda: facts(wall))
    wall.page.select_option("#aids-map", "noise")
    until(lambda: overlay(wall).all())


@pytest.mark.parametrize(("stream", "tilt"), [("front/depth", 0.0), ("side/depth", 15.0)])
def test_a_plane_has_the_tilt_of_its_camera(wall: Wall, stream: str, tilt: float) -> None:
    open_aids(wall, stream)
    wall.page.check("#aids-plane")
    plane = until(lambda: facts(wall)["plane"])
    assert plane["tiltDeg"] == pytest.approx(tilt, abs=0.15)
    assert plane["rmsM"] < 0.0005, "millimetres are rounded"
    shown = wall.page.inner_text("#aids-plane-text")
    assert re.fullmatch(r"RMS 0\.\d\d mm, tilt \d+\.\d°, \d+ mm away", shown), shown
    save_screenshot(wall, "aids-plane")

    # A rectangle that is dragged, and one that the keyboard makes smaller.
    box = wall.page.locator(".enlarged .view canvas").first.bounding_box()
    x, y = box["x"] + box["width"] * 0.5, box["y"] + box["height"] * 0.5
    wall.page.mouse.move(x, y)
    wall.page.mouse.down()
    wall.page.mouse.move(x + 40, y + 50, steps=4)
    wall.page.mouse.up()
    until(lambda: 20 < facts(wall)["plane"]["points"] < plane["points"] / 2)
    dragged = facts(wall)["plane"]
    assert dragged["tiltDeg"] == pytest.approx(tilt, abs=1.5)
    wall.page.focus("#aids-plane-move")
    wall.page.keyboard.press("Shift+ArrowRight")
    until(lambda: facts(wall)["plane"]["points"] > dragged["points"])


def test_one_to_one_shows_a_pixel_as_a_pixel(wall: Wall) -> None:
    open_aids(wall, "still/color")
    image = wall.page.locator(".enlarged .view canvas").first
    assert image.bounding_box()["width"] != WIDTH
    wall.page.check("#aids-own-size")
    until(lambda: (image.bounding_box()["width"], image.bounding_box()["height"]) == (WIDTH, HEIGHT))
    wait_for_colors(wall, "still/color", *PATCHES)
    # The pixel under the pointer is still the right one.
    wall.hover("still/color", PATCHES[0])
    until(lambda: re.search(r"\((79|80), (59|60)\)", wall.hovered()), wall.hovered)
    wall.page.keyboard.press("Escape")
    wall.wait_for("() => document.querySelector('.own-size') === null")
    assert not wall.page.locator("#aids").is_visible()


def test_numbers_are_asked_for_only_while_they_are_shown(wall: Wall) -> None:
    sent = wall.sent("watch")
    wall.page.reload()
    wall.wait_for_image(*STREAMS)
    assert not any(w.get("measure") for w in sent[-1])
    open_aids(wall, "still/depth")
    wall.until(lambda: [w["stream"] for w in sent[-1] if w.get("measure")] == ["still/depth"], lambda: sent[-1])
    wall.page.keyboard.press("a")
    wall.until(lambda: not any(w.get("measure") for w in sent[-1]), lambda: sent[-1])
    assert not wall.page.locator("#aids").is_visible()


def test_the_aids_have_no_serious_violation_of_accessibility(wall: Wall) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not in tests/readers/node_modules; make test puts it there")
    wall.page.evaluate(AXE.read_text() + "; undefined")
    open_aids(wall, "still/color")
    measure(wall)
    found = violations(wall, "aids of colour")
    wall.tile("still/depth").focus()
    wall.page.keyboard.press("Enter")
    until(lambda: facts(wall)["holes"] is not None)
    wall.page.check("#aids-plane")
    found += violations(wall, "aids of depth")
    assert found == []
