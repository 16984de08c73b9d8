"""When a recording lost something, on the page and in the API, of a rig whose camera loses frames."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from page import CHROMIUM, RIG, SIMULATED, Address, Wall, address, free_port, opened, until
from playwright.sync_api import Browser, Route
from test_daemon import binary, running, runtime
from test_page import AXE, CODES, browser, save_screenshot, violations
from test_page_panels import ask, start, stop

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

# A second of damaged frames, again and again: a recording always has some.
FAULTS = "".join(f'[[camera.fault]]\nkind = "damaged"\nat_s = {at}.0\ncount = 15\n' for at in range(4, 900, 8))
DISK = (255, 116, 102)
CAMERA = (242, 193, 78)


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Address]:
    folder = tmp_path_factory.mktemp("losses")
    cameras = SIMULATED.format(name="bad") + FAULTS + SIMULATED.format(name="good")
    (folder / "losses.toml").write_text(RIG.format(name="losses", port=free_port()) + cameras)
    with running(binary, runtime, folder / "losses.log", "run", str(folder / "losses.toml"), codes=CODES):
        yield address(binary, runtime, "losses")




def shown(wall: Wall) -> str:
    return wall.page.inner_text(".loss-moment")


def sums(history: dict[str, Any], kind: str) -> Counter[str]:
    counts: Counter[str] = Counter()
    for bucket in history["buckets"]:
        counts.update(bucket[kind])
    return counts


def test_the_losses_of_a_recording_are_shown_over_its_time_on_every_page(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as wall:
        wall.wait_for_image("bad/color", "good/color")
        start(wall)
        wall.page.wait_for_selector("#loss-time", state="visible")
        until(lambda: re.match(r"Losses at \d+ moments? of \d\d:\d\d", shown(wall)), lambda: shown(wall))
        until(lambda: "bad/" in wall.page.inner_text("#losses"), lambda: wall.page.inner_text("#losses"))
        # By keyboard, moment by moment; a screen reader gets the same text.
        wall.focus_by_keyboard(".loss-strip input")
        until(lambda: re.match(r"\d\d:\d\d to \d\d:\d\d: \d+ ", shown(wall)), lambda: shown(wall))
        spoken = wall.page.get_attribute(".loss-strip input", "aria-valuetext")
        assert spoken is not None
        assert re.match(r"1 of \d+: \d\d:\d\d to", spoken)
        # A page that is opened late shows the losses from before.
        with opened(browser, rig) as late:
            late.page.wait_for_selector("#loss-time", state="visible")
            until(lambda: "damage" in late.page.inner_text("#losses"), lambda: late.page.inner_text("#losses"))
        stop(wall)
        # And so does one that is opened after it has ended; the API has the same numbers.
        history = ask(rig, "GET", "/v1/record/losses")
        recording = ask(rig, "GET", "/v1/record")
        assert history["path"] == recording["path"]
        assert sums(history, "frames") == recording["frames_dropped"]
        assert sums(history, "missing") == recording["missing"]
        assert sums(history, "sets") == recording["dropped"]
        assert recording["frames_dropped"]["device_error"] > 0
        assert all(bucket["from_s"] < history["duration_s"] + 2 for bucket in history["buckets"])
    with opened(browser, rig) as after:
        after.page.wait_for_selector("#loss-time", state="visible")
        until(lambda: shown(after).startswith("Losses at"), lambda: shown(after))


HISTORY = {
    "duration_s": 1000.0,
    "bucket_s": 2.0,
    "buckets": [
        {"from_s": 100.0, "sets": {}, "missing": {}, "frames": {"device_gap": 1}},
        *({"from_s": 500.0 + 2 * i, "sets": {"disk_slow": 10}, "missing": {}, "frames": {}} for i in range(50)),
    ],
}
PIXEL = """([x, y]) => {
    const canvas = document.querySelector(".loss-strip canvas");
    const data = canvas.getContext("2d").getImageData(x * canvas.width, y * canvas.height, 1, 1).data;
    return data[3] === 0 ? null : [...data.slice(0, 3)];
}"""


def shown_at(wall: Wall, x: float) -> str:
    """What is said of the place of the strip that is pointed at, from 0 to 1. The strip may still move as the page grows around it."""
    box = wall.page.locator(".loss-strip").bounding_box()
    assert box is not None
    for y in (5, 6):
        wall.page.mouse.move(box["x"] + x * box["width"], box["y"] + y)
    return shown(wall)


def test_a_lost_frame_is_small_and_a_gap_stands_out(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as wall:
        wall.wait_for_image("bad/color", "good/color")

        def answer(route: Route) -> None:
            path = ask(rig, "GET", "/v1/record")["path"]
            # The strip is as long as the recording at least: here it has lasted a thousand seconds.
            end = {"from_s": 998.0, "sets": {}, "missing": {}, "frames": {"no_slot": 1}}
            history = {**HISTORY, "path": path, "buckets": [*HISTORY["buckets"], end]}
            route.fulfill(body=json.dumps(history), content_type="application/json")

        wall.page.route("**/v1/record/losses", answer)
        start(wall)
        wall.page.wait_for_selector("#loss-time", state="visible")
        until(lambda: shown(wall) == "Losses at 3 moments of 16:40", lambda: shown(wall))
        pixel = lambda x, y: wall.page.evaluate(PIXEL, [x, y])
        # The frame: a low bar and nothing above it. The gap: from bottom to top, for its whole time.
        assert tuple(pixel(0.101, 0.95)) == CAMERA
        assert pixel(0.101, 0.6) is None
        for x in (0.502, 0.55, 0.598):
            assert tuple(pixel(x, 0.05)) == DISK
        assert pixel(0.48, 0.95) is None
        assert pixel(0.62, 0.95) is None
        until(lambda: shown_at(wall, 0.55) == "08:20 to 10:00: 500 sets lost (the disk is too slow)", lambda: shown(wall))
        save_screenshot(wall, "losses")
        until(lambda: shown_at(wall, 0.3).startswith("Losses at 3 moments"), lambda: shown(wall))
        causes = wall.page.locator(".loss-cause").all_inner_texts()
        assert causes == ["disk", "computer", "camera or cable"]
        if AXE.exists():
            wall.page.evaluate(AXE.read_text() + "; undefined")
            assert violations(wall, "losses") == []
        stop(wall)
