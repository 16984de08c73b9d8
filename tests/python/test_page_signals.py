"""Signals and episodes on the live page, in a real browser."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import depthrig
import pytest
from page import CHROMIUM, RIG, SIMULATED, Address, Wall, address, blank, free_port, opened, until
from playwright.sync_api import Browser
from test_daemon import binary, command, environment, running, runtime
from test_page import AXE, CODES, VISIBILITY, browser, save_screenshot, violations

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

PUBLISHER = Path(__file__).with_name("signal_publisher.py")
ARM = "arm/joint_position"
GRIPPER = "gripper/state"
STATE = [
    depthrig.SignalField("width", "f32", 1, "m"),
    depthrig.SignalField("closed", "bool"),
    depthrig.SignalField("phase", "text"),
]
TASK = 'put "the cup" on <b>the plate</b> 🤖'
REQUIRED = f'[[signal]]\nname = "{ARM}"\nrequired = true\nsilent_s = 1.0\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("signals")


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, folder: Path) -> Iterator[Address]:
    text = RIG.format(name="signals", port=free_port()) + SIMULATED.format(name="front") + REQUIRED
    (folder / "signals.toml").write_text(text)
    # The required signal is silent at the end of some tests.
    with running(binary, runtime, folder / "signals.log", "run", str(folder / "signals.toml"), codes=(*CODES, 3)):
        yield address(binary, runtime, "signals")


@contextmanager
def arm(runtime: Path, rate_hz: float = 50.0) -> Iterator[subprocess.Popen[str]]:
    """The joints of a robot, published by a process of their own."""
    words = [sys.executable, str(PUBLISHER), str(runtime), ARM, "shoulder,elbow,wrist", str(rate_hz)]
    process = subprocess.Popen(words, env=environment(runtime), stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "publishing\n"
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image("front/color", "front/depth")
        yield wall


def card(name: str) -> str:
    return f'.signal[data-signal="{name}"]'


def card_text(wall: Wall, name: str) -> str:
    return wall.page.inner_text(card(name))


def values(wall: Wall, name: str) -> dict[str, str]:
    rows = wall.page.eval_on_selector_all(
        f"{card(name)} .signal-values div", "rows => rows.map(r => [r.children[0].innerText, r.children[1].textContent])"
    )
    return dict(rows)


def open_panel(wall: Wall, key: str, name: str) -> None:
    wall.page.keyboard.press(key)
    wall.page.wait_for_selector(f"#panel .{name}")


COLORS = """canvas => {
    const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    const bins = new Set();
    for (let i = 0; i < data.length; i += 4) {
        if (data[i + 3] === 255) bins.add([data[i], data[i + 1], data[i + 2]].map(v => v >> 5).join());
    }
    return bins.size;
}"""


def test_a_signal_is_shown_with_its_values_rate_and_plot(wall: Wall, runtime: Path) -> None:
    with arm(runtime):
        open_panel(wall, "i", "signals")
        wall.wait_for_state(card(ARM), "live")
        until(lambda: len(values(wall, ARM)) == 3)
        assert list(values(wall, ARM)) == ["shoulder", "elbow", "wrist"]
        first = float(values(wall, ARM)["shoulder"].removesuffix(" rad"))
        until(lambda: float(values(wall, ARM)["shoulder"].removesuffix(" rad")) > first + 5)
        until(lambda: " Hz" in card_text(wall, ARM), lambda: card_text(wall, ARM))
        assert "required" in card_text(wall, ARM)
        # Three lines that lie above each other, each in a colour of its own.
        until(lambda: wall.page.eval_on_selector(f"{card(ARM)} canvas", COLORS) >= 1)
        save_screenshot(wall, "signals")


def test_booleans_and_text_are_text_whatever_is_in_it(wall: Wall, runtime: Path) -> None:
    text = "<b>gräsping</b> \"it\"\n🤖"
    with (
        arm(runtime),
        depthrig.Signal(GRIPPER, STATE, runtime_dir=runtime) as signal,
    ):
        open_panel(wall, "i", "signals")

        def shown() -> dict[str, str]:
            signal.publish([0.25, True, text])
            wall.page.wait_for_timeout(50)
            return values(wall, GRIPPER) if wall.page.locator(card(GRIPPER)).count() else {}

        until(lambda: shown().get("phase") == text, shown)
        assert {"width": "0.2500 m", "closed": "yes"}.items() <= shown().items()
        assert wall.page.locator(f"{card(GRIPPER)} b").count() == 0
        # One line: the field that is a number.
        assert wall.page.locator(f"{card(GRIPPER)} .swatch").count() == 1


def test_a_required_signal_that_falls_silent_is_a_fault_with_its_cure(wall: Wall, runtime: Path) -> None:
    open_panel(wall, "i", "signals")
    wall.wait_for_state(card(ARM), "failed")
    assert "Start the program" in card_text(wall, ARM)
    wall.wait_for_state("#ready", "no-go")
    assert ARM in wall.page.inner_text("#ready")
    with arm(runtime) as process:
        wall.wait_for_state(card(ARM), "live")
        until(lambda: len(values(wall, ARM)) == 3)
        process.kill()
        wall.wait_for_state(card(ARM), "failed")
        assert "no recording begins" in card_text(wall, ARM)


def test_values_are_asked_for_only_while_they_are_shown(wall: Wall, runtime: Path) -> None:
    messages = wall.sent("signals")
    wall.page.reload()
    wall.wait_for_image("front/color")
    with arm(runtime):
        wall.page.wait_for_timeout(500)
        assert messages == []
        open_panel(wall, "i", "signals")
        wall.until(lambda: messages and [s["signal"] for s in messages[-1]] == [ARM], lambda: messages[-3:])
        wall.page.evaluate(VISIBILITY, "hidden")
        wall.until(lambda: messages[-1] is None)
        wall.page.evaluate(VISIBILITY, "visible")
        wall.until(lambda: messages[-1] is not None)
        wall.page.keyboard.press("i")
        wall.until(lambda: messages[-1] is None)
        number = len(messages)
        wall.page.wait_for_timeout(500)
        assert len(messages) == number


def test_each_point_is_sent_once(wall: Wall, runtime: Path) -> None:
    messages = wall.sent("signals")
    wall.page.reload()
    wall.wait_for_image("front/color")
    with arm(runtime):
        open_panel(wall, "i", "signals")

        def after() -> list[int]:
            return [s["after"] for message in messages for s in message or [] if s["signal"] == ARM]

        wall.until(lambda: len([n for n in after() if n > 0]) > 5, after)
        assert after() == sorted(after())


def test_two_pages_show_a_signal_over_one_channel_end(browser: Browser, rig: Address, wall: Wall, runtime: Path) -> None:
    with arm(runtime), opened(browser, rig) as other:
        for page in (wall, other):
            open_panel(page, "i", "signals")
            page.wait_for_state(card(ARM), "live")
        for page in (wall, other):
            until(lambda page=page: len(values(page, ARM)) == 3)


def start_recording(wall: Wall) -> None:
    # The required signal comes.
    until(lambda: not wall.page.inner_text("#ready").startswith("No-go"), lambda: wall.page.inner_text("#ready"))
    wall.press_record("recording")


def stop_recording(wall: Wall) -> None:
    wall.press_record("idle")


def episodes(binary: str, runtime: Path) -> list[dict[str, Any]]:
    """The episodes of the last recording, from its file."""
    path = json.loads(command(binary, runtime, "record", "status", "--json"))["path"]
    return tomllib.loads((Path(path) / "session.toml").read_text()).get("episodes", [])


def press(wall: Wall, key: str, state: str) -> None:
    """Presses a key of the episodes. The state may be shown before the answer has come, and no other key is taken."""
    with wall.page.expect_response("**/v1/episode") as answer:
        wall.page.keyboard.press(key)
    answer.value.finished()
    until(lambda: wall.state("#episode") == state, wall.record_text)


def test_episodes_are_made_and_judged_with_keys(wall: Wall, binary: str, runtime: Path) -> None:
    with arm(runtime):
        start_recording(wall)
        wall.page.keyboard.press("t")
        wall.page.keyboard.type(TASK)
        wall.page.keyboard.press("Enter")
        wall.page.keyboard.type("slowly")
        wall.page.keyboard.press("Escape")
        press(wall, "e", "running")
        until(lambda: "Episode 1 runs" in wall.page.inner_text("#episode-text"))
        assert TASK in wall.page.inner_text("#episode-text")
        assert wall.page.locator("#episode-text b").count() == 0
        # It is counted in seconds.
        counted = re.compile(r"\b\d\d:(?!00)\d\d\b")
        text = lambda: wall.page.inner_text("#episode-text")
        until(lambda: counted.search(text()), text)
        press(wall, "s", "success")
        press(wall, "e", "running")
        press(wall, "f", "failure")
        press(wall, "e", "running")
        press(wall, "x", "discarded")
        press(wall, "e", "running")
        press(wall, "e", "kept")
        # One that has ended is judged, too.
        press(wall, "f", "failure")
        until(lambda: wall.page.inner_text("#episode-counts") == "3 kept, 1 discarded")
        save_screenshot(wall, "episodes")
        stop_recording(wall)
        made = episodes(binary, runtime)
    assert [e.get("outcome") for e in made] == ["success", "failure", None, "failure"]
    assert [e.get("discarded", False) for e in made] == [False, False, True, False]
    assert made[0]["task"] == f"{TASK}\nslowly"


def test_the_panel_lists_the_episodes_and_judges_earlier_ones(
    browser: Browser, rig: Address, wall: Wall, binary: str, runtime: Path
) -> None:
    with arm(runtime), opened(browser, rig) as other:
        start_recording(wall)
        for task in ("one", "two"):
            command(binary, runtime, "episode", "start", "--task", task)
            until(lambda: wall.state("#episode") == "running", wall.record_text)
            command(binary, runtime, "episode", "stop", "success")
        for page in (wall, other):
            open_panel(page, "j", "episodes")
            until(lambda page=page: page.page.locator(".episode-row[data-state=success]").count() == 2)
        save_screenshot(wall, "episodes-panel")
        wall.page.click('.episode-row[data-number="1"] button:has-text("Discard")')
        for page in (wall, other):
            page.wait_for_state('.episode-row[data-number="1"]', "discarded")
        wall.page.click('.episode-row[data-number="1"] button:has-text("Success")')
        other.wait_for_state('.episode-row[data-number="1"]', "success")
        # The other page has it, too, though the status has neither its count nor this episode.
        wall.page.click('.episode-row[data-number="1"] button:has-text("Failure")')
        other.wait_for_state('.episode-row[data-number="1"]', "failure")
        wall.page.click('.episode-row[data-number="1"] button:has-text("No judgement")')
        wall.wait_for_state('.episode-row[data-number="1"]', "kept")
        wall.page.keyboard.press("j")
        stop_recording(wall)
        # The list stays after the end, and judges nothing any more.
        open_panel(wall, "j", "episodes")
        until(lambda: wall.page.locator(".episode-row button").count() == 0)
        assert wall.page.locator(".episode-row").count() == 2
    assert [e.get("outcome") for e in episodes(binary, runtime)] == [None, "success"]


def error(wall: Wall) -> str:
    return wall.page.inner_text("#episode-error")


def test_what_the_daemon_refuses_is_said(wall: Wall, binary: str, runtime: Path) -> None:
    assert not wall.page.locator("#episode").is_visible()
    wall.page.keyboard.press("e")
    until(lambda: "no recording" in error(wall), lambda: error(wall))
    wall.page.keyboard.press("t")
    until(lambda: "start one first" in error(wall), lambda: error(wall))
    with arm(runtime):
        start_recording(wall)
        wall.page.keyboard.press("s")
        until(lambda: "no episode has ended" in error(wall), lambda: error(wall))
        # The page does not know yet that another program has begun one.
        wall.page.route("**/v1/episode", lambda route: (command(binary, runtime, "episode", "start"), route.continue_()))
        wall.page.keyboard.press("e")
        until(lambda: "episode 1 is running" in error(wall), lambda: error(wall))
        wall.page.unroute_all()
        until(lambda: wall.state("#episode") == "running", wall.record_text)
        press(wall, "x", "discarded")
        assert error(wall) == ""
        stop_recording(wall)


def test_a_key_that_comes_to_nothing_says_so(browser: Browser, rig: Address) -> None:
    with blank(browser, rig.origin) as wall:
        wall.open(f"{rig.origin}/#token=")
        wall.wait_for_state("#connection", "denied")
        wall.page.keyboard.press("a")
        until(lambda: "none is shown" in wall.page.inner_text("#problem"))
        for key, place in (("Space", "#record-error"), ("e", "#episode-error"), ("s", "#episode-error")):
            wall.page.keyboard.press(key)
            until(lambda place=place: "no connection" in wall.page.inner_text(place))


def test_signals_and_episodes_have_no_serious_violation_of_accessibility(wall: Wall, runtime: Path) -> None:
    if not AXE.exists():
        pytest.skip("axe-core is not in tests/readers/node_modules; make test puts it there")
    wall.page.evaluate(AXE.read_text() + "; undefined")
    with arm(runtime):
        start_recording(wall)
        press(wall, "e", "running")
        open_panel(wall, "i", "signals")
        until(lambda: len(values(wall, ARM)) == 3)
        found = violations(wall, "signals")
        press(wall, "e", "kept")
        open_panel(wall, "j", "episodes")
        wall.page.wait_for_selector(".episode-row")
        found += violations(wall, "episodes")
        stop_recording(wall)
    assert found == []
