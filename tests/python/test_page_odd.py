"""What a page may meet: a daemon of another version, images that change their size, large ones, and a second page that was faster."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from page import (
    CHROMIUM,
    FAR,
    HOLE,
    MIDDLE,
    NEAR,
    RIG,
    Address,
    address,
    blank,
    files_camera,
    free_port,
    opened,
    pattern,
    until,
)
from playwright.sync_api import Browser, Route, WebSocketRoute
from test_daemon import WAIT_S, binary, running, runtime
from test_page import CODES, browser, millimetres, wait_for_colors

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

SOCKET = re.compile(r"/v1/live")
LARGE = (3840, 2160)
HEAD = struct.Struct("<HBBHHHHHHQqqfI")


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    """A camera of an ordinary size and a large one."""
    folder = tmp_path_factory.mktemp("odd")
    text = RIG.format(name="odd", port=free_port()) + files_camera("still", pattern(folder / "still"))
    text += files_camera("large", pattern(folder / "large", *LARGE, rate_hz=2.0))
    (folder / "odd.toml").write_text(text)
    with running(binary, runtime, folder / "log", "run", str(folder / "odd.toml"), codes=CODES):
        yield address(binary, runtime, "odd")


def test_a_large_camera_is_seen_to_the_millimetre(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as wall:
        wall.wait_for_image("large/color", "large/depth")
        wait_for_colors(wall, "large/color", NEAR, FAR, MIDDLE)
        # Enlarged it has as many pixels as the window, and the pointer still shows the full image.
        wall.tile("large/depth").click()
        wall.wait_for_image("large/depth")
        for patch in (NEAR, FAR, MIDDLE):
            wall.hover("large/depth", patch)
            until(lambda patch=patch: abs((millimetres(wall.hovered()) or 0) - patch.depth_mm) <= 1, wall.hovered)


def test_a_page_of_another_version_says_so_and_goes_on(browser: Browser, rig: Address) -> None:
    def older(route: Route) -> None:
        answer = route.fetch()
        html = re.sub(r'(name="?depthrig-version"? content=")[^"]*', r"\g<1>0.0.9", answer.text())
        assert "0.0.9" in html
        headers = {k: v for k, v in answer.headers.items() if k not in ("content-length", "content-encoding", "etag")}
        route.fulfill(body=html, headers=headers)

    with blank(browser, rig.origin) as wall:
        # A page that did not come from this computer may not speak to it.
        wall.page.context.grant_permissions(["local-network-access"])
        wall.page.route(re.compile(r"^http://[^/]+/$"), older)
        wall.open(rig.text)
        wall.wait_for_state("#connection", "live")
        note = wall.page.locator("#version-note")
        note.wait_for(state="visible")
        assert "This page is of depthrig 0.0.9" in note.inner_text()
        wall.wait_for_image("still/depth")
        wall.page.unroute_all()
        wall.page.click("#reload")
        wall.wait_for_image("still/depth")
        assert not note.is_visible()


def through(page_says: Callable[[str | bytes], str | bytes | None]) -> Callable[[WebSocketRoute], None]:
    """A connection whose messages to the page go through a function; `None` drops one."""

    def connect(route: WebSocketRoute) -> None:
        server = route.connect_to_server()

        def forward(message: str | bytes) -> None:
            changed = page_says(message)
            if changed is not None:
                route.send(changed)

        server.on_message(forward)

    return connect


def test_a_stream_whose_size_changes_is_drawn_in_its_new_size(browser: Browser, rig: Address) -> None:
    sizes = {"width": 0, "height": 0}

    def resized(message: str | bytes) -> str | bytes:
        """Depth of the ordinary camera as another one: of the size asked for, its right half farther away."""
        if isinstance(message, str) or sizes["width"] == 0:
            return message
        head = list(HEAD.unpack(message[: HEAD.size]))
        if head[1] != 2 or head[7] != 320:
            return message
        columns, rows = sizes["width"], sizes["height"]
        head[4:9] = [1, columns, rows, columns, rows]
        depth = np.full((rows, columns), 777, "<u2")
        depth[:, (columns + 1) // 2 :] = 2500
        return HEAD.pack(*head) + depth.tobytes()

    with blank(browser, rig.origin) as wall:
        wall.page.route_web_socket(SOCKET, through(resized))
        wall.open(rig.text)
        wall.wait_for_image("still/depth")
        for columns, rows in ((200, 300), (640, 100), (1, 1)):
            sizes.update(width=columns, height=rows)
            wall.wait_for(
                "([s, w, h]) => { const c = document.querySelector(`[data-stream='${s}'] canvas`);"
                " return c.width === w && c.height === h; }",
                "still/depth",
                columns,
                rows,
            )
            wall.wait_for_image("still/depth")
            # Each half has one colour from its upper to its lower end.
            above_left, above_right, left, right = wall.colors("still/depth", NEAR, FAR, MIDDLE, HOLE)
            assert (above_left, above_right) == (left, right)
            assert (left == right) == (columns == 1)


def test_a_key_before_the_first_status_is_answered(browser: Browser, rig: Address) -> None:
    is_late = {"now": True}

    def late(message: str | bytes) -> str | bytes | None:
        return None if is_late["now"] and isinstance(message, str) and '"status"' in message else message

    with blank(browser, rig.origin) as wall:
        wall.page.route_web_socket(SOCKET, through(late))
        wall.open(rig.text)
        wall.wait_for_state("#connection", "live")
        wall.page.keyboard.press("Space")
        until(lambda: "not yet said" in wall.page.inner_text("#record-error"), wall.record_text)
        wall.page.keyboard.press("a")
        until(lambda: "none is shown" in wall.page.inner_text("#problem"))
        is_late["now"] = False
        # What was said is out of date, and the key works.
        wall.wait_for_state("#record-state", "idle")
        until(lambda: wall.page.inner_text("#record-error") == "", wall.record_text)


def test_a_page_that_missed_a_start_says_so_and_stops_nothing(browser: Browser, rig: Address) -> None:
    is_late = {"now": False}

    def late(message: str | bytes) -> str | bytes | None:
        return None if is_late["now"] and isinstance(message, str) and '"status"' in message else message

    with opened(browser, rig) as first, blank(browser, rig.origin) as second:
        second.page.route_web_socket(SOCKET, through(late))
        second.open(rig.text)
        second.wait_for_image("still/color")
        until(lambda: second.page.is_enabled("#start-stop"), second.record_text)
        is_late["now"] = True
        first.press_record("recording")
        assert second.state("#record-state") == "idle"
        second.page.keyboard.press("Space")
        error = second.page.locator("#record-error")
        error.wait_for(state="visible")
        until(lambda: "already" in error.inner_text() or "running" in error.inner_text(), error.inner_text)
        assert first.state("#record-state") == "recording"
        is_late["now"] = False
        second.wait_for_state("#record-state", "recording")
        second.page.keyboard.press("Space")
        first.wait_for_state("#record-state", "idle")
        second.wait_for_state("#record-state", "idle")
