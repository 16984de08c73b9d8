"""The 3-D view of the live page in a real browser: points are where the geometry says, in their colours.

A point must appear where the matrix that the page says it used puts it; nothing of depthrig is in the scene.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from page import CHROMIUM, RIG, Address, Wall, address, files_camera, free_port, opened, until
from page_scene import BLUE, CAMERAS, FRONT, HALF_M, HEIGHT, PLANE_M, RED, SIDE, SQUARE, WIDTH
from PIL import Image
from playwright.sync_api import Browser, sync_playwright
from test_daemon import WAIT_S, binary, running, runtime
from test_page import AXE, CODES, VISIBILITY, browser, save_screenshot, set_range, violations

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

STREAMS = [f"{camera.name}/{stream}" for camera in CAMERAS for stream in ("color", "depth")]
COLOR_ERROR = 25
"""Most that a colour changes on its way: JPEG, and colour at half the size."""
TINTS = {"front": (1.0, 0.47, 0.36), "side": (0.36, 0.72, 1.0)}
FAULTY = """
[[camera]]
name = "pulled"
backend = "synthetic"
model = "generic"
cheap = true
[[camera.stream]]
name = "color"
width = 320
height = 240
rate_hz = 15.0
[[camera.stream]]
name = "depth"
width = 320
height = 240
rate_hz = 15.0
"""
# Again and again: a page that is opened late sees it, too.
FAULTY += "".join(f'[[camera.fault]]\nkind = "unplug"\nat_s = {at}.0\nduration_s = 8.0\n' for at in range(25, 900, 30))


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("space")
    cameras = "".join(camera.write(folder / camera.name) for camera in CAMERAS)
    (folder / "space.toml").write_text(RIG.format(name="space", port=free_port()) + cameras)
    with running(binary, runtime, folder / "space.log", "run", str(folder / "space.toml"), codes=CODES):
        yield address(binary, runtime, "space")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image(*STREAMS)
        yield wall


def open_view(wall: Wall, cameras: int = 2) -> None:
    wall.page.keyboard.press("v")
    wall.wait_for("([n]) => depthrig.view.isOpen && depthrig.view.placed.length === n", cameras)
    wall.wait_for("([n]) => depthrig.view.frames > 0 && depthrig.view.offered === n", cameras * WIDTH * HEIGHT)
    # It may have been placed before all cameras had an image.
    wall.page.keyboard.press("0")
    settle(wall)


def settle(wall: Wall) -> None:
    """Until frames of what was asked for last are on the screen."""
    wall.page.wait_for_timeout(300)
    frames = wall.page.evaluate("depthrig.view.frames")
    wall.wait_for("([n]) => depthrig.view.frames >= n", frames + 4)
    wall.page.wait_for_timeout(200)


def show_only(wall: Wall, *cameras: str) -> None:
    for box in wall.page.locator("#cloud-cameras label").all():
        box.locator("input").set_checked(box.inner_text().strip() in cameras)
    settle(wall)


def pixels(wall: Wall, *points: tuple[float, float, float]) -> list[tuple[int, int, int]]:
    """The colours on the screen where points of the mount must be."""
    view = wall.page.evaluate("depthrig.view")
    box = wall.page.locator("#cloud-canvas").bounding_box()
    matrix = np.array(view["viewProjection"]).reshape(4, 4).T
    with Image.open(io.BytesIO(wall.page.screenshot())) as screen:
        shown = screen.convert("RGB")
    colors = []
    for point in points:
        x, y, _, w = matrix @ np.array([*point, 1.0])
        assert max(abs(x), abs(y)) < w, f"{point} is not in the view"
        place = (box["x"] + (x / w + 1) / 2 * box["width"], box["y"] + (1 - y / w) / 2 * box["height"])
        colors.append(shown.getpixel((int(place[0]), int(place[1]))))
    return colors


def is_near(color: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
    return max(abs(a - b) for a, b in zip(color, other)) <= COLOR_ERROR


def on_plane(dx: float, dy: float) -> tuple[float, float, float]:
    return (SQUARE[0] + dx, SQUARE[1] + dy, PLANE_M)


def square_and_surroundings() -> dict[tuple[float, float, float], tuple[int, int, int]]:
    inner = HALF_M - 0.025
    outer = HALF_M + 0.025
    corners = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    expected = {on_plane(a * inner, b * inner): RED for a, b in corners}
    return expected | {on_plane(a * outer, b * outer): BLUE for a, b in corners if (a, b) != (0, 0)}


def check_square(wall: Wall) -> None:
    expected = square_and_surroundings()

    def wrong() -> list[str]:
        shown = pixels(wall, *expected)
        return [
            f"{color} at {point} where {right} is"
            for (point, right), color in zip(expected.items(), shown)
            if not is_near(color, right)
        ]

    until(lambda: wrong() == [], wrong)


@pytest.mark.parametrize("cameras", [("front",), ("side",), ("front", "side")], ids=["front", "side", "both"])
def test_points_are_where_pose_and_lens_say_in_the_colour_of_the_other_lens(wall: Wall, cameras: tuple[str]) -> None:
    open_view(wall)
    show_only(wall, *cameras)
    check_square(wall)
    if len(cameras) == 2:
        save_screenshot(wall, "cloud")
    # From another side, and nearer.
    wall.page.focus("#cloud-canvas")
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp", "+", "Shift+ArrowLeft"):
        wall.page.keyboard.press(key)
    settle(wall)
    check_square(wall)


def test_the_tint_says_which_camera_a_point_is_from(wall: Wall) -> None:
    open_view(wall)
    wall.page.select_option("#cloud-paint", "camera")
    # The left edge is seen by front alone, the right one by side alone.
    _, front = FRONT.seen(FRONT.depth)
    _, side = SIDE.seen(SIDE.depth)
    left = tuple(front[120, 12])
    right = tuple(side[120, 300])
    assert left[0] < side[..., 0].min()
    assert right[0] > front[..., 0].max()
    settle(wall)

    def wrong() -> list[str]:
        shown = zip(("front", "side"), pixels(wall, left, right))
        hues = [(name, np.array(color) / max(1, max(color))) for name, color in shown]
        return [f"{name}: {hue}" for name, hue in hues if np.abs(hue - np.array(TINTS[name])).max() > 0.08]

    until(lambda: wrong() == [], wrong)
    save_screenshot(wall, "cloud-tint")


def test_the_points_end_where_the_image_of_the_lens_ends(wall: Wall) -> None:
    """Colour shows no wrong lens of depth: a point at the wrong place of a plane has the colour of that place."""
    open_view(wall)
    show_only(wall, "side")
    wall.page.select_option("#cloud-paint", "camera")
    _, seen = SIDE.seen(SIDE.depth)
    inside, outside = [], []
    for edge, inner in ((seen[120, 0], seen[120, 10]), (seen[0, 160], seen[10, 160]), (seen[239, 160], seen[229, 160])):
        outwards = (edge - inner) / np.linalg.norm(edge - inner)
        inside.append(tuple(edge - 0.02 * outwards))
        outside.append(tuple(edge + 0.02 * outwards))

    def levels() -> list[int]:
        return [max(color) for color in pixels(wall, *inside, *outside)]

    until(lambda: min(levels()[:3]) > 90 > max(levels()[3:]), levels)


def test_a_camera_that_is_not_chosen_is_neither_shown_nor_watched(wall: Wall) -> None:
    sent = watched(wall)
    open_view(wall)
    wall.until(lambda: sent and sorted(w["stream"] for w in sent[-1]) == STREAMS, lambda: sent)
    assert all(w["width"] <= 320 and w["rate_hz"] <= 10 for w in sent[-1])
    show_only(wall, "side")
    wall.until(lambda: sorted(w["stream"] for w in sent[-1]) == ["side/color", "side/depth"], lambda: sent[-1])
    _, front = FRONT.seen(FRONT.depth)
    (color,) = pixels(wall, tuple(front[120, 12]))
    assert max(color) < 90, "the points of front are gone"


def watched(wall: Wall) -> list[list[dict]]:
    """The watch lists that the page sends from now on; it is loaded anew for that."""
    sent = wall.sent("watch")
    wall.page.reload()
    wall.wait_for_image(*STREAMS)
    return sent


def test_escape_closes_the_view_and_its_streams_and_a_hidden_tab_watches_nothing(wall: Wall) -> None:
    sent = watched(wall)
    on_the_wall = sent[-1]
    open_view(wall)
    assert not wall.page.locator("#wall").is_visible()
    wall.page.evaluate(VISIBILITY, "hidden")
    wall.until(lambda: sent[-1] == [], lambda: sent[-1])

    def is_still() -> bool:
        frames = wall.page.evaluate("depthrig.view.frames")
        wall.page.wait_for_timeout(700)
        return wall.page.evaluate("depthrig.view.frames") == frames

    # What was on its way still comes.
    until(is_still)
    assert is_still()
    wall.page.evaluate(VISIBILITY, "visible")
    settle(wall)
    wall.page.keyboard.press("Escape")
    wall.page.wait_for_selector("#cloud", state="hidden")
    wall.until(lambda: sorted(map(str, sent[-1])) == sorted(map(str, on_the_wall)), lambda: sent[-1])
    wall.wait_for_image(*STREAMS)
    frames = wall.page.evaluate("depthrig.view.frames")
    wall.page.wait_for_timeout(500)
    assert wall.page.evaluate("depthrig.view.frames") == frames


def test_keys_and_mouse_turn_move_and_zoom_and_reset_goes_back(wall: Wall) -> None:
    open_view(wall)
    home = matrix(wall)
    box = wall.page.locator("#cloud-canvas").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def drag() -> None:
        wall.page.mouse.move(*middle)
        wall.page.mouse.down()
        wall.page.mouse.move(middle[0] + 60, middle[1] + 20, steps=3)
        wall.page.mouse.up()

    def wheel() -> None:
        wall.page.mouse.move(*middle)
        wall.page.mouse.wheel(0, 200)

    press = wall.page.keyboard.press
    touches = wall.page.context.new_cdp_session(wall.page)

    def pinch() -> None:
        def touch(kind: str, apart: int) -> None:
            points = [{"x": middle[0] + side * apart, "y": middle[1], "id": side} for side in (0, 1)] if apart else []
            touches.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        touch("touchStart", 100)
        for apart in (120, 140, 160):
            touch("touchMove", apart)
        touch("touchEnd", 0)

    moves = [drag, wheel, pinch, *(lambda k=k: press(k) for k in ("ArrowLeft", "Shift+ArrowUp", "-"))]
    for move in moves:
        move()
        until(lambda: not np.allclose(matrix(wall), home, atol=1e-3))
        press("0")
        until(lambda: np.allclose(matrix(wall), home, atol=0.05), lambda: matrix(wall) - home)
    assert wall.page.input_value("#cloud-paint") == "color"
    press("t")
    assert wall.page.input_value("#cloud-paint") == "distance"


def matrix(wall: Wall) -> np.ndarray:
    return np.array(wall.page.evaluate("depthrig.view.viewProjection"))


def test_the_range_of_the_page_cuts_what_is_beyond_it(wall: Wall) -> None:
    open_view(wall)
    show_only(wall, "front")
    check_square(wall)
    set_range(wall, 0.3, 0.9)
    until(lambda: max(pixels(wall, on_plane(0, 0))[0]) < 90)
    set_range(wall, 0.3, 1.2)
    check_square(wall)


def test_a_hundred_thousand_points_are_drawn_several_times_a_second(wall: Wall) -> None:
    open_view(wall)
    box = wall.page.locator("#cloud-canvas").bounding_box()
    rates = {}
    for points in ("50000", "100000", "300000"):
        wall.page.select_option("#cloud-points", points)
        settle(wall)
        frames = wall.page.evaluate("depthrig.view.frames")
        begun = time.monotonic()
        wall.page.mouse.move(box["x"] + 400, box["y"] + 200)
        wall.page.mouse.down()
        while time.monotonic() - begun < 3:
            wall.page.mouse.move(box["x"] + 400 + 100 * np.sin(time.monotonic()), box["y"] + 200)
        wall.page.mouse.up()
        seconds = time.monotonic() - begun
        view = wall.page.evaluate("depthrig.view")
        rates[points] = (view["frames"] - frames) / seconds
        print(
            f"{view['points']} of {view['offered']} points: {rates[points]:.1f} frames/s, {view['ms']:.0f} ms a frame"
        )
    assert rates["100000"] > 1, "loose, for a loaded computer"
    wall.page.select_option("#cloud-points", "auto")
    wall.page.wait_for_timeout(3000)
    view = wall.page.evaluate("depthrig.view")
    print(f"automatic: {view['points']} of {view['offered']} points, {view['ms']:.0f} ms a frame")


def test_a_lost_graphics_context_is_said_and_comes_back(wall: Wall) -> None:
    open_view(wall)
    wall.page.evaluate(LOSE)
    wall.wait_for("() => /graphics/.test(document.querySelector('#cloud-message').innerText)")
    wall.page.evaluate("lose.restoreContext()")
    wall.wait_for("() => document.querySelector('#cloud-message').innerText === ''")
    settle(wall)
    check_square(wall)


LOSE = """() => {
    const context = document.querySelector("#cloud-canvas").getContext("webgl2");
    window.lose = context.getExtension("WEBGL_lose_context");
    lose.loseContext();
}"""


def test_the_view_has_no_serious_violation_of_accessibility(wall: Wall) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not in tests/readers/node_modules; make test puts it there")
    open_view(wall)
    wall.page.evaluate(AXE.read_text() + "; undefined")
    assert violations(wall, "cloud") == []


@contextmanager
def chromium(*arguments: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=arguments, ignore_default_args=["--enable-unsafe-swiftshader"]
        )
        yield browser
        browser.close()


def test_without_webgl_the_view_names_the_cure_and_the_wall_works(rig: Address) -> None:
    # In a thread of its own: this browser beside the one of the other tests.
    import threading

    failures: list[BaseException] = []

    def look() -> None:
        try:
            with chromium("--disable-gpu", "--disable-software-rasterizer") as plain, opened(plain, rig) as wall:
                wall.wait_for_image(*STREAMS)
                wall.page.keyboard.press("v")
                wall.wait_for("() => /WebGL2/.test(document.querySelector('#cloud-message').innerText)")
                assert "graphics acceleration" in wall.page.inner_text("#cloud-message")
                save_screenshot(wall, "cloud-without-webgl")
                wall.page.keyboard.press("Escape")
                wall.wait_for_image(*STREAMS)
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=look)
    thread.start()
    thread.join(2 * WAIT_S)
    assert failures == []
    assert not thread.is_alive()


def test_a_camera_that_is_pulled_turns_grey_and_one_without_a_lens_is_named(
    browser: Browser, binary: str, runtime: Path, tmp_path: Path
) -> None:
    blind = tmp_path / "blind"
    FRONT.write(blind)
    manifest = blind / "camera.toml"
    lines = manifest.read_text().splitlines()
    manifest.write_text("\n".join(line for line in lines if not line.startswith(("intrinsics", "pose_in_device"))))
    rig = tmp_path / "pulled.toml"
    rig.write_text(RIG.format(name="pulled", port=free_port()) + FAULTY + files_camera("blind", manifest))
    with running(binary, runtime, tmp_path / "pulled.log", "run", str(rig), codes=CODES):
        where = address(binary, runtime, "pulled")
        with opened(browser, where) as wall:
            wall.wait_for_image("pulled/depth")
            open_view(wall, 1)
            wall.wait_for("() => /blind\\/depth.*lens/.test(document.querySelector('#cloud-message').innerText)")
            wall.wait_for("() => depthrig.view.stale.includes('pulled/depth')")
            wall.wait_for("() => /pulled: no image/.test(document.querySelector('#cloud-labels').innerText)")
            wall.page.wait_for_timeout(300)
            save_screenshot(wall, "cloud-pulled")
