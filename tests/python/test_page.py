"""The live page of the real daemon in a real browser, Debian's Chromium.

What it shows is compared with the images that the cameras were given; what it must not do is tried.
"""

from __future__ import annotations

import http.client
import os
import re
import signal
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from page import (
    CHROMIUM,
    FAR,
    HOLE,
    MIDDLE,
    NEAR,
    PATCHES,
    RIG,
    SIMULATED,
    Address,
    Patch,
    Wall,
    address,
    blank,
    files_camera,
    free_port,
    opened,
    pattern,
    until,
)
from playwright.sync_api import Browser, sync_playwright
from test_daemon import ROOT, WAIT_S, binary, command, running, runtime

__all__ = ["binary", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

AXE = ROOT / "tests" / "readers" / "node_modules" / "axe-core" / "axe.min.js"
STREAMS = [f"{camera}/{stream}" for camera in ("front", "left", "still") for stream in ("color", "depth")]
JPEG_ERROR = 12
"""Most that a colour of an even patch changes on its way to the page."""
HOLE_COLOR = (0x26, 0x28, 0x2C)
"""That of daemon/page/colormap.js; the palette of depth has none as dark."""
PAGES = 8
MARKUP = "<img src=x onerror=alert(1)>"
AWAY = f"""
[[camera]]
name = "gone"
backend = "v4l2"
serial = "{MARKUP}"
[[camera.stream]]
name = "color"
"""
PULLED = """
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
[[camera.fault]]
kind = "unplug"
at_s = 3.0
duration_s = 3600.0
"""


CODES = (0, 3, -signal.SIGKILL)
"""A daemon may lose frames: a browser beside it takes all of a small computer. One is killed."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rig file `wall.toml`, with its images, and the datasets."""
    path = tmp_path_factory.mktemp("wall")
    still = files_camera("still", pattern(path / "still"))
    text = RIG.format(name="wall", port=free_port())
    (path / "wall.toml").write_text(text + SIMULATED.format(name="front") + SIMULATED.format(name="left") + still)
    return path


@pytest.fixture(scope="module")
def dataset(binary: str, runtime: Path, folder: Path) -> Path:
    """Three seconds of the pattern and nothing else."""
    rig = folder / "short.toml"
    text = RIG.format(name="short", port=free_port())
    rig.write_text(text + files_camera("still", folder / "still" / "camera.toml"))
    out = folder / "short"
    arguments = ("run", str(rig), "--record", str(out), "--seconds", "3")
    with running(binary, runtime, folder / "short.log", *arguments, codes=CODES) as daemon:
        daemon.wait(WAIT_S)
    (found,) = out.iterdir()
    return found


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, folder: Path, dataset: Path) -> Iterator[Address]:
    """The rig of which most tests look at the page; `dataset` is made first so that they do not disturb each other."""
    with running(binary, runtime, folder / "wall.log", "run", str(folder / "wall.toml"), codes=CODES):
        yield address(binary, runtime, "wall")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        yield wall


def near(color: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
    return max(abs(a - b) for a, b in zip(color, other)) <= JPEG_ERROR


def wait_for_colors(wall: Wall, stream: str, *patches: Patch) -> None:
    """Until the patches are shown in the colours that the camera sees: an image that is late is grey for a moment."""
    colors: list[tuple[int, int, int]] = []

    def are_near() -> bool:
        colors[:] = wall.colors(stream, *patches)
        return all(near(color, patch.color) for patch, color in zip(patches, colors))

    until(are_near, lambda: f"{colors} where the camera sees {[patch.color for patch in patches]}")


def millimetres(text: str) -> float | None:
    """The depth in the text beside the pointer."""
    found = re.search(r"(?<![\d.])(\d+(?:\.\d+)?) mm\b", text)
    return float(found[1]) if found else None


def save_screenshot(wall: Wall, name: str) -> None:
    if "DEPTHRIG_SCREENSHOTS" in os.environ:
        path = Path(os.environ["DEPTHRIG_SCREENSHOTS"])
        path.mkdir(parents=True, exist_ok=True)
        wall.page.screenshot(path=path / f"{name}.png")


def test_every_stream_is_drawn_as_the_camera_sees_it(wall: Wall) -> None:
    wall.wait_for_image(*STREAMS)
    assert sorted(wall.streams()) == STREAMS
    wait_for_colors(wall, "still/color", *PATCHES)
    set_range(wall, 0.6, 3.0)
    edge = Patch(0.49, 0.49, NEAR.color, NEAR.depth_mm)
    colors: list[tuple[int, int, int]] = []

    def from_red_over_green_to_blue() -> bool:
        colors[:] = wall.colors("still/depth", NEAR, MIDDLE, FAR, HOLE, edge)
        return all(max(color) == color[i] > 80 + min(color) for i, color in enumerate(colors[:3]))

    until(from_red_over_green_to_blue, lambda: colors)
    # Depth is neither averaged nor compressed, so equal depths have equal colours up to the edge.
    assert colors[4] == colors[0]
    assert max(colors[3]) - min(colors[3]) <= JPEG_ERROR, f"a hole is grey, which no depth is, not {colors[3]}"
    save_screenshot(wall, "wall")


def set_range(wall: Wall, near_m: float, far_m: float) -> None:
    if wall.page.is_checked("#auto-range"):
        wall.page.uncheck("#auto-range")
    wall.page.fill("#near", str(near_m))
    wall.page.fill("#far", str(far_m))


def test_depth_out_of_the_range_has_the_colours_of_its_ends_and_holes_their_own(wall: Wall) -> None:
    wall.wait_for_image("still/depth")
    found: list[tuple[int, int, int]] = []

    def colors() -> list[tuple[int, int, int]]:
        found[:] = wall.colors("still/depth", NEAR, MIDDLE, FAR, HOLE)
        return found

    set_range(wall, 0.2, 4.0)
    until(lambda: len(set(colors())) == 4 and found[3] == HOLE_COLOR, lambda: found)
    set_range(wall, 0.2, 1.1)
    # Both are beyond the far end now. An image that is drawn anew, or late, has other colours for a moment.
    until(lambda: len({*colors()[:3], HOLE_COLOR}) == 3 and found[1:] == [found[1], found[1], HOLE_COLOR], lambda: found)


@pytest.mark.parametrize("patch", [NEAR, MIDDLE, FAR], ids=["near", "middle", "far"])
def test_hovering_over_depth_shows_the_millimetres(wall: Wall, patch: Patch) -> None:
    wall.wait_for_image("still/depth")
    wall.hover("still/depth", patch)
    until(lambda: abs((millimetres(wall.hovered()) or 0) - patch.depth_mm) <= 1, wall.hovered)


def test_hovering_over_a_hole_names_it(wall: Wall) -> None:
    wall.wait_for_image("still/depth")
    wall.hover("still/depth", NEAR)
    until(lambda: millimetres(wall.hovered()), wall.hovered)
    wall.hover("still/depth", HOLE)
    until(lambda: "hole" in wall.hovered().lower(), wall.hovered)


def test_a_recording_is_made_with_the_keyboard_alone(wall: Wall, binary: str, runtime: Path, folder: Path) -> None:
    keyboard = wall.page.keyboard
    note = "<script>alert(1)</script>"
    wall.wait_for_image(*STREAMS)
    wall.focus_by_keyboard("#scene")
    keyboard.type("kitchen sink")
    keyboard.press("Escape")
    wall.press_record("recording")
    save_screenshot(wall, "recording")
    keyboard.press("n")
    wall.wait_for("() => document.activeElement.matches('input, textarea')")
    keyboard.type(note)
    keyboard.press("Enter")
    until(lambda: wall.page.input_value("#notes") == "")
    wall.press_record("idle")
    (dataset,) = (folder / "datasets").iterdir()
    session = tomllib.loads((dataset / "session.toml").read_text())
    assert session["scene"] == "kitchen sink"
    assert note in (dataset / "session.toml").read_text().replace("\\", "")
    # 3: intact, but a set was lost on a loaded computer.
    command(binary, runtime, "verify", str(dataset), "--decode", codes=(0, 3))


def test_a_key_enlarges_a_tile_and_escape_restores_the_wall(wall: Wall) -> None:
    wall.wait_for_image(*STREAMS)
    first = wall.page.locator("section.tile").first
    before = first.bounding_box()
    wall.page.keyboard.press("1")
    wall.wait_for("() => document.querySelector('section.tile').classList.contains('enlarged')")
    until(lambda: first.bounding_box()["width"] > 1.5 * before["width"])
    save_screenshot(wall, "enlarged")
    wall.page.keyboard.press("Escape")
    wall.wait_for("() => document.querySelector('.tile.enlarged') === null")
    # All tiles are as wide as each other again, whatever room the rest of the page leaves them.
    widths = wall.page.eval_on_selector_all("section.tile", "tiles => tiles.map(t => t.getBoundingClientRect().width)")
    assert widths == pytest.approx([widths[1]] * len(STREAMS), abs=2)
    assert 0 < widths[0] < 1.5 * before["width"]


def test_keys_in_a_text_field_are_text(wall: Wall) -> None:
    wall.focus_by_keyboard("#scene")
    wall.page.keyboard.type("1 new ?")
    assert wall.page.input_value("#scene") == "1 new ?"
    assert wall.page.locator(".tile.enlarged").count() == 0
    assert wall.state("#record-state") == "idle"
    assert not wall.page.locator("#help").is_visible()


def test_a_hidden_tab_draws_nothing_until_it_is_seen_again(wall: Wall) -> None:
    wall.wait_for_image(*STREAMS)
    wall.page.evaluate(VISIBILITY, "hidden")
    # What was on its way still comes.
    wall.page.wait_for_timeout(1000)
    drawn = wall.drawn()
    wall.page.wait_for_timeout(1500)
    assert wall.drawn() == drawn
    wall.page.evaluate(VISIBILITY, "visible")
    until(lambda: wall.drawn() > drawn + len(STREAMS))


VISIBILITY = """state => {
    Object.defineProperty(document, "visibilityState", { value: state, configurable: true });
    Object.defineProperty(document, "hidden", { value: state === "hidden", configurable: true });
    document.dispatchEvent(new Event("visibilitychange"));
}"""


def test_two_pages_draw_at_once(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as one, opened(browser, rig) as other:
        for wall in (one, other):
            wall.wait_for_image(*STREAMS)
        before = (one.drawn(), other.drawn())
        until(lambda: one.drawn() > before[0] + 10 and other.drawn() > before[1] + 10)


def test_a_ninth_page_is_refused_with_a_reason(browser: Browser, rig: Address, wall: Wall) -> None:
    wall.page.evaluate(CONNECT, [PAGES - 1, rig.token])
    with blank(browser, rig.origin) as ninth:
        ninth.open(rig.text)
        ninth.wait_for("() => /pages/i.test(document.querySelector('#connection').innerText)")
        assert ninth.state("#connection") != "live"
    assert wall.state("#connection") == "live"


CONNECT = """([count, token]) => Promise.all([...Array(count)].map(() => new Promise((done, failed) => {
    const socket = new WebSocket(`ws://${location.host}/v1/live`);
    socket.onopen = () => socket.send(JSON.stringify({ token }));
    socket.onmessage = done;
    socket.onclose = e => failed(new Error(`closed with ${e.code} ${e.reason}`));
    (window.sockets ??= []).push(socket);
})))"""


@pytest.mark.parametrize("fragment", ["", "#token=", f"#token={'0' * 64}"], ids=["none", "empty", "wrong"])
def test_without_the_token_nothing_is_shown(browser: Browser, rig: Address, fragment: str) -> None:
    with blank(browser, rig.origin) as wall:
        wall.open(f"{rig.origin}/{fragment}")
        wall.wait_for_state("#connection", "denied")
        assert "depthrig open" in wall.page.inner_text("body")
        wall.page.wait_for_timeout(500)
        assert wall.drawn() == 0
        assert wall.page.locator("section.tile").count() == 0


def test_the_token_leaves_the_address_and_a_reload_still_has_it(wall: Wall, rig: Address) -> None:
    assert "token" not in wall.page.url
    assert rig.token not in wall.page.content()
    wall.page.reload()
    wall.wait_for_state("#connection", "live")
    assert wall.page.evaluate("document.cookie") == ""
    assert not any(rig.token in url for url in wall.requests if not url.startswith(rig.text))


def ask(rig: Address, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", rig.port, timeout=WAIT_S)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"localhost:{rig.port}", **headers}.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    body = b"" if answer.status == 101 else answer.read()
    connection.close()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}, body


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://localhost:{port}", 101),
        ("http://127.0.0.1:{port}", 403),
        ("https://localhost:{port}", 403),
        ("http://localhost:1", 403),
        ("http://localhost:{port}.evil.example", 403),
        ("http://evil.example", 403),
        ("null", 403),
    ],
)
def test_a_page_of_another_origin_gets_no_socket(rig: Address, origin: str, status: int) -> None:
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13"}
    upgrade["Sec_WebSocket_Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    assert ask(rig, "/v1/live", Origin=origin.format(port=rig.port), **upgrade)[0] == status


def test_the_port_serves_strangers_nothing(rig: Address) -> None:
    assert ask(rig, "/v1/status")[0] == 401
    assert ask(rig, "/v1/status", Authorization="Bearer 0")[0] == 401
    assert ask(rig, "/v1/status", Authorization=f"Bearer {rig.token}")[0] == 200
    for host in ("evil.example", f"evil.example:{rig.port}"):
        assert ask(rig, "/", Host=host)[0] == 403
        assert ask(rig, "/v1/status", Host=host, Authorization=f"Bearer {rig.token}")[0] == 403


def test_the_page_has_a_policy_that_allows_nothing_from_elsewhere(rig: Address) -> None:
    status, headers, body = ask(rig, "/")
    assert status == 200
    policy = {words[0]: words[1:] for words in map(str.split, headers["content-security-policy"].split(";")) if words}
    for what in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert policy[what] == ["'none'"], what
    for what in ("script-src", "style-src", "connect-src"):
        assert policy[what] == ["'self'"], what
    assert policy["require-trusted-types-for"] == ["'script'"]
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert rig.token.encode() not in body
    # Asked again, the same file is not sent again.
    assert ask(rig, "/", If_None_Match=headers["etag"])[0] == 304


@pytest.mark.parametrize(
    "path", ["/../Cargo.toml", "/%2e%2e/Cargo.toml", "/page/app.js", "/nothing.js", "//etc/passwd"]
)
def test_only_files_of_the_page_are_served(rig: Address, path: str) -> None:
    assert ask(rig, path)[0] in (400, 401, 404)


def test_the_page_is_small(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as wall:
        wall.wait_for_image(*STREAMS)
        timing = wall.page.evaluate(TIMING)
    print(f"first paint after {timing['paint_ms']:.0f} ms, {timing['bytes']} bytes in {timing['requests']} requests")
    # Scripts are modules, which the first paint does not wait for.
    assert timing["before_paint"] < 5
    assert 0 < timing["bytes"] <= 300_000
    assert all(url.startswith((f"{wall.origin}/", f"blob:{wall.origin}/")) for url in wall.requests)


TIMING = """() => {
    const files = [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
        .filter(e => !new URL(e.name).pathname.startsWith("/v1/") && !e.name.startsWith("blob:"));
    return {
        paint_ms: performance.getEntriesByType("paint")[0]?.startTime ?? 0,
        bytes: files.reduce((sum, e) => sum + e.transferSize, 0),
        requests: files.length,
        before_paint: files.filter(e => e.entryType === "navigation" || e.renderBlockingStatus === "blocking").length,
    };
}"""


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not in tests/readers/node_modules; make test puts it there")
def test_no_serious_violation_of_accessibility(wall: Wall) -> None:
    wall.wait_for_image(*STREAMS)
    wall.page.evaluate(AXE.read_text() + "; undefined")
    found = violations(wall, "wall")
    wall.page.keyboard.press("1")
    wall.wait_for("() => document.querySelector('.tile.enlarged') !== null")
    found += violations(wall, "enlarged")
    wall.page.keyboard.press("Escape")
    wall.page.keyboard.press("?")
    wall.page.wait_for_selector("#help", state="visible")
    save_screenshot(wall, "help")
    found += violations(wall, "help")
    wall.page.keyboard.press("Escape")
    wall.page.wait_for_selector("#help", state="hidden")
    assert found == []


def violations(wall: Wall, view: str) -> list[str]:
    found = wall.page.evaluate("axe.run(document, { resultTypes: ['violations'] })")["violations"]
    return [
        f"{view}: {v['id']} ({v['impact']}): {v['help']}: {node['html']}"
        for v in found
        if v["impact"] in ("serious", "critical")
        for node in v["nodes"]
    ]


def test_a_lost_camera_says_why_and_a_lost_daemon_is_found_again(
    browser: Browser, binary: str, runtime: Path, folder: Path
) -> None:
    rig = folder / "away.toml"
    text = RIG.format(name="away", port=free_port())
    rig.write_text(text + files_camera("still", folder / "still" / "camera.toml") + AWAY + PULLED)
    log = folder / "away.log"
    with running(binary, runtime, log, "run", str(rig), codes=CODES) as daemon, blank(browser, "") as wall:
        first = address(binary, runtime, "away")
        wall.open(first.text)
        wall.wait_for_image("still/color")
        for camera, why in (("gone", MARKUP), ("pulled", "not plugged in")):
            tile = f'section.tile[data-camera="{camera}"]'
            wall.wait_for_state(tile, "failed")
            wall.wait_for("([t, why]) => document.querySelector(`${t} .message`).innerText.includes(why)", tile, why)
        wall.wait_for_state('section.tile[data-stream="still/color"]', "live")
        save_screenshot(wall, "failed")

        daemon.kill()
        wall.wait_for_state("#connection", "lost")
        wall.wait_for("() => document.querySelectorAll('section.tile[data-state=\"live\"]').length === 0")
        with running(binary, runtime, log, "run", str(rig), codes=CODES):
            # Its token is another one, and the page says how to get it.
            wall.wait_for_state("#connection", "denied")
            assert "depthrig open" in wall.page.inner_text("body")
            second = address(binary, runtime, "away")
            assert (second.port, second.token != first.token) == (first.port, True)
            wall.open(second.text)
            wall.wait_for_state("#connection", "live")
            wall.wait_for_image("still/color")


def test_a_replay_is_scrubbed(browser: Browser, binary: str, runtime: Path, folder: Path, dataset: Path) -> None:
    with running(binary, runtime, folder / "replay.log", "replay", str(dataset), "--rig", "again", "--loop", codes=CODES):
        where = address(binary, runtime, "again")
        with opened(browser, where) as wall:
            wall.wait_for_image("still/color", "still/depth")
            wall.page.wait_for_selector("#replay", state="visible")
            scrub = wall.page.locator("#scrub")
            last = int(float(scrub.get_attribute("max") or 0))
            assert last > 5
            command(binary, runtime, "replay", "pause", "--rig", "again")
            for place in (last - 1, 1):
                scrub.evaluate(SCRUB, place)
                until(lambda place=place: abs(replayed_set(binary, runtime) - place) <= 1, scrub.input_value)
            save_screenshot(wall, "replay")


SCRUB = """(scrub, place) => {
    scrub.value = String(place);
    scrub.dispatchEvent(new Event("input", { bubbles: true }));
    scrub.dispatchEvent(new Event("change", { bubbles: true }));
}"""


def replayed_set(binary: str, runtime: Path) -> int:
    text = command(binary, runtime, "replay", "status", "--json", "--rig", "again")
    found = re.search(r'"set":\s*(\d+)', text)
    return int(found[1]) if found else -1


def test_a_live_rig_has_no_scrubber(wall: Wall) -> None:
    wall.wait_for_image("still/color")
    assert not wall.page.locator("#replay").is_visible()
