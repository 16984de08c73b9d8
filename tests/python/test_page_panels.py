"""The panels of the live page, of the real daemon in a real browser: recordings, takes, doctor, controls, calibration.

What the page does is read back from the dataset, the rig file and the API.
"""

from __future__ import annotations

import http.client
import json
import re
import shutil
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from page import (
    CHROMIUM,
    NEAR,
    RIG,
    SIMULATED,
    Address,
    Wall,
    address,
    blank,
    files_camera,
    free_port,
    opened,
    pattern,
    until,
)
from playwright.sync_api import Browser, Locator
from test_daemon import WAIT_S, binary, running, runtime
from test_page import AXE, CODES, MARKUP, browser, save_screenshot, violations, wait_for_colors

__all__ = ["binary", "browser", "runtime"]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")

STREAMS = ["front/color", "front/depth", "still/color", "still/depth"]
OTHER_PAGE_S = 2.0
"""So soon another page shows a value that this one has set."""
SLACK_S = 3.0
"""More of it on a small computer, which runs two browsers' pages and the rig."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("panels")
    cameras = SIMULATED.format(name="front") + files_camera("still", pattern(path / "still"))
    (path / "panels.toml").write_text(RIG.format(name="panels", port=free_port()) + cameras)
    return path


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, folder: Path) -> Iterator[Address]:
    with running(binary, runtime, folder / "panels.log", "run", str(folder / "panels.toml"), codes=CODES):
        yield address(binary, runtime, "panels")


@pytest.fixture
def wall(browser: Browser, rig: Address) -> Iterator[Wall]:
    with opened(browser, rig) as wall:
        wall.wait_for_image(*STREAMS)
        yield wall


def ask(rig: Address, method: str, path: str, body: Any = None) -> Any:
    """What the API answers; an error fails."""
    connection = http.client.HTTPConnection("127.0.0.1", rig.port, timeout=WAIT_S)
    headers = {"Authorization": f"Bearer {rig.token}", "Content-Type": "application/json"}
    connection.request(method, path, json.dumps(body) if body is not None else None, headers)
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    assert answer.status < 300, f"{method} {path}: {answer.status} {text!r}"
    return json.loads(text) if text else None


def datasets(folder: Path) -> list[Path]:
    """The oldest first."""
    found = (folder / "datasets").glob("*/session.toml")
    return [path.parent for path in sorted(found, key=lambda path: session(path.parent)["started_utc_ns"])]


def session(dataset: Path) -> dict[str, Any]:
    return tomllib.loads((dataset / "session.toml").read_text())


def record(rig: Address, seconds: float = 1.5, scene: str = "table") -> str:
    """Records for a moment; the name of the recording."""
    path = Path(ask(rig, "POST", "/v1/record/start", {"scene": scene})["path"])
    time.sleep(seconds)
    ask(rig, "POST", "/v1/record/stop", {})
    return path.name


def press(wall: Wall, *keys: str) -> None:
    for key in keys:
        wall.page.keyboard.press(key)


def open_panel(wall: Wall, key: str, title: str) -> Locator:
    press(wall, key)
    until(lambda: wall.page.inner_text("#panel-title") == title, lambda: wall.page.inner_text("body"))
    return wall.page.locator("#panel-body")


def row(wall: Wall, name: str) -> Locator:
    return wall.page.locator(f'li.recording[data-name="{name}"]')


def button(place: Locator, text: str) -> Locator:
    return place.locator("button").get_by_text(text, exact=True)


def wait_for_text(place: Locator, text: str) -> None:
    until(lambda: text in place.inner_text(), place.inner_text)


def start(wall: Wall) -> None:
    wall.press_record("recording")
    # Its first set.
    until(lambda: re.search(r"[1-9]\d* sets", wall.page.inner_text("#record-progress")))


def stop(wall: Wall) -> None:
    wall.press_record("idle")


# The colour in the middle of a patch of the small image.
THUMB = """([name, x, y]) => {
    const canvas = document.querySelector(`li.recording[data-name="${name}"] canvas`);
    if (!canvas || canvas.hidden) return null;
    const pixel = canvas.getContext("2d").getImageData(x * canvas.width, y * canvas.height, 1, 1);
    return [...pixel.data.slice(0, 3)];
}"""


def test_a_recording_comes_into_the_list_with_an_image_and_is_marked(wall: Wall, folder: Path) -> None:
    open_panel(wall, "l", "Recordings")
    start(wall)
    stop(wall)
    dataset = datasets(folder)[-1]
    entry = row(wall, dataset.name)
    entry.wait_for()
    until(lambda: wall.page.evaluate(THUMB, [dataset.name, 0.5, 0.5]), entry.inner_text)
    for mark, other in (("Good", "Bad"), ("Bad", "Good")):
        button(entry, mark).click()
        until(lambda mark=mark: session(dataset).get("mark") == mark.lower(), lambda: session(dataset))
        until(lambda mark=mark: button(entry, mark).get_attribute("aria-pressed") == "true")
        assert button(entry, other).get_attribute("aria-pressed") == "false"
    wall.page.locator("#panel-body").get_by_text("Undo", exact=True).click()
    until(lambda: session(dataset).get("mark") == "good", lambda: session(dataset))
    # Pressed again it takes its mark back; the file has it before the page.
    until(lambda: button(entry, "Good").get_attribute("aria-pressed") == "true")
    button(entry, "Good").click()
    until(lambda: session(dataset).get("mark") is None, lambda: session(dataset))
    assert wall.page.get_by_text("Delete").count() == 0
    save_screenshot(wall, "recordings")


def test_the_list_says_what_a_recording_is(wall: Wall, rig: Address) -> None:
    name = record(rig, 2.0, "sink")
    open_panel(wall, "l", "Recordings")
    entry = row(wall, name)
    entry.wait_for()
    listed = next(one for one in ask(rig, "GET", "/v1/recordings")["recordings"] if one["name"] == name)
    text = entry.inner_text()
    assert "sink" in text
    assert re.search(rf"\b{listed['sets']} sets\b", text)
    assert "4 streams" in text
    words = {"whole": "Whole", "lost": "Something lost"}
    assert words[listed["health"]] in text


def test_markup_in_a_recording_is_text(wall: Wall, folder: Path) -> None:
    wall.page.fill("#scene", MARKUP)
    wall.page.fill("#operator", MARKUP)
    wall.page.keyboard.press("Escape")
    start(wall)
    open_panel(wall, "l", "Recordings")
    press(wall, "m")
    wait_for_text(wall.page.locator("#record"), "Mark added")
    stop(wall)
    wall.page.fill("#scene", "")
    wall.page.fill("#operator", "")
    dataset = datasets(folder)[-1]
    entry = row(wall, dataset.name)
    entry.wait_for()
    assert entry.inner_text().count(MARKUP) == 2
    assert wall.page.locator("#panel img").count() == 0
    notes = session(dataset)["notes"]
    assert [note["text"] for note in notes] == ["mark"]


def test_a_report_opens_in_a_tab_of_its_own(wall: Wall, rig: Address) -> None:
    name = record(rig)
    open_panel(wall, "l", "Recordings")
    entry = row(wall, name)
    with wall.page.context.expect_page() as tab:
        button(entry, "Report").click()
    report = tab.value
    report.wait_for_load_state()
    assert name in report.content()
    assert rig.token not in report.url
    assert report.evaluate("window.opener") is None
    report.close()


def test_a_dataset_is_watched_and_the_live_rig_records_meanwhile(wall: Wall, rig: Address, folder: Path) -> None:
    name = record(rig, 3.0)
    open_panel(wall, "l", "Recordings")
    button(row(wall, name), "Watch").click()
    wall.page.wait_for_selector("#replay", state="visible")
    wall.wait_for_state("#connection", "live")
    assert wall.page.inner_text("#replay-dataset") == name
    assert f"dataset={name}" in wall.page.url
    assert "token" not in wall.page.url
    press(wall, "Escape")
    wall.wait_for_image("still/color", "still/depth")
    wait_for_colors(wall, "still/color", NEAR)
    save_screenshot(wall, "watched")

    # Steering: pause, seek, step.
    press(wall, "p")
    wall.wait_for_state("#replay", "paused")
    scrub = wall.page.locator("#scrub")
    last = int(float(scrub.get_attribute("max") or 0))
    assert last > 5
    for place in (last - 1, 2):
        scrub.evaluate(SCRUB, place)
        until(lambda place=place: f"set {place + 1} of" in position(wall), lambda: position(wall))
    press(wall, "ArrowRight")
    until(lambda: "set 4 of" in position(wall), lambda: position(wall))

    # The live rig goes on: a recording from here is of its cameras.
    count = len(datasets(folder))
    start(wall)
    stop(wall)
    until(lambda: len(datasets(folder)) == count + 1)
    wall.page.reload()
    wall.wait_for_state("#connection", "live")
    wall.page.wait_for_selector("#replay", state="visible")
    assert wall.page.inner_text("#replay-dataset") == name

    press(wall, "Escape")
    wall.page.wait_for_selector("#replay", state="hidden")
    wall.wait_for_image(*STREAMS)
    assert "dataset" not in wall.page.url
    wall.page.go_back()
    wall.page.wait_for_selector("#replay", state="visible")
    wall.wait_for_state("#connection", "live")
    wall.page.get_by_text("Back to live", exact=True).click()
    wall.page.wait_for_selector("#replay", state="hidden")
    wall.wait_for_image(*STREAMS)


def test_the_3d_view_goes_from_the_dataset_to_the_live_rig(wall: Wall, rig: Address) -> None:
    name = record(rig, 2.0)
    wall.open(f"{rig.origin}/?dataset={name}#token={rig.token}")
    wall.page.wait_for_selector("#replay", state="visible")
    wall.wait_for_state("#connection", "live")
    # A status that was sent before the click shows the old choice once more.
    wall.page.click("#replay-loop")
    until(lambda: wall.page.is_checked("#replay-loop"))
    wall.page.locator("#scrub").evaluate(SCRUB, 0)
    press(wall, "v")
    wall.wait_for("() => depthrig.view.isOpen && depthrig.view.points > 0")
    # Before the next message there is no point of the dataset left.
    left = wall.page.evaluate(
        """() => {
            document.getElementById("back-to-live").click();
            return document.querySelectorAll("section.tile").length;
        }"""
    )
    assert left == 0
    wall.wait_for_state("#connection", "live")
    wall.wait_for("() => depthrig.view.isOpen && depthrig.view.points > 0")
    press(wall, "Escape")
    wall.wait_for_image(*STREAMS)


SCRUB = """(scrub, place) => {
    scrub.value = String(place);
    scrub.dispatchEvent(new Event("input", { bubbles: true }));
}"""


def position(wall: Wall) -> str:
    return wall.page.inner_text("#replay-position")


def test_two_pages_steer_the_same_dataset(browser: Browser, rig: Address) -> None:
    name = record(rig, 2.0)
    with opened(browser, rig) as one, opened(browser, rig) as two:
        for wall in (one, two):
            wall.open(f"{rig.origin}/?dataset={name}#token={rig.token}")
            wall.page.wait_for_selector("#replay", state="visible")
            wall.wait_for_state("#connection", "live")
        one.page.click("#replay-loop")
        until(lambda: two.page.is_checked("#replay-loop"))
        # It may have come to its end meanwhile, where it pauses; one that is paused stays so when it is sought.
        is_playing = two.state("#replay") == "playing"
        one.page.locator("#scrub").evaluate(SCRUB, 0)
        if not is_playing:
            press(two, "p")
        two.wait_for_state("#replay", "playing")
        press(one, "p")
        two.wait_for_state("#replay", "paused")
        press(two, "p")
        one.wait_for_state("#replay", "playing")


def test_one_dataset_is_shown_at_a_time_and_a_page_may_change_it(browser: Browser, rig: Address) -> None:
    first, second = record(rig), record(rig)
    with opened(browser, rig) as one, opened(browser, rig) as two:
        open_panel(one, "l", "Recordings")
        for name in (first, second, first):
            button(row(one, name), "Watch").click()
            until(lambda name=name: one.page.inner_text("#replay-dataset") == name)
            one.wait_for_state("#connection", "live")
        two.open(f"{rig.origin}/?dataset={second}#token={rig.token}")
        wait_for_text(two.page.locator("#connection"), "another page shows")
        one.page.get_by_text("Back to live", exact=True).click()
        # It is tried again, and there is room now.
        two.wait_for_state("#connection", "live")
        two.wait_for_image("still/color")


@pytest.mark.parametrize("name", ["nothing-of-that", "../panels.toml", MARKUP], ids=["missing", "outside", "markup"])
def test_a_dataset_that_is_not_there_is_said_and_left(browser: Browser, rig: Address, name: str) -> None:
    with blank(browser, rig.origin) as wall:
        wall.open(rig.text)
        wall.wait_for_state("#connection", "live")
        wall.page.evaluate("name => location.assign(`/?dataset=${encodeURIComponent(name)}`)", name)
        wall.wait_for_state("#connection", "lost")
        wait_for_text(wall.page.locator("#connection"), "This dataset is not shown")
        assert wall.page.locator("section.tile").count() == 0
        wall.page.get_by_text("Back to live", exact=True).click()
        wall.wait_for_image(*STREAMS)


def test_a_recording_that_was_removed_meanwhile_leaves_the_list(wall: Wall, rig: Address, folder: Path) -> None:
    name = record(rig)
    # Nothing may be written into it any more when it is removed.
    until((folder / "datasets" / name / "report.html").is_file)
    panel = open_panel(wall, "l", "Recordings")
    entry = row(wall, name)
    entry.wait_for()
    bad = button(entry, "Bad").element_handle()
    shutil.rmtree(folder / "datasets" / name)
    # Whether or not the list was refreshed meanwhile.
    bad.evaluate("button => button.click()")
    wait_for_text(panel, f"{name} was not marked")
    until(lambda: row(wall, name).count() == 0)


def test_odd_recordings_are_listed_with_why(wall: Wall, rig: Address, folder: Path) -> None:
    base = folder / "datasets" / record(rig)
    # Nothing may be written into it any more while it is copied.
    until((base / "report.html").is_file)
    cut, later = base.with_name("cut"), base.with_name("later")
    try:
        for copy in (cut, later):
            shutil.copytree(base, copy, ignore=shutil.ignore_patterns(".*", "*.tmp"))
        text = (later / "session.toml").read_text()
        (later / "session.toml").write_text(re.sub(r"(?m)^format = .*$", 'format = "depthrig-99"', text))
        (cut / "session.toml").write_text("format = [[[")
        panel = open_panel(wall, "l", "Recordings")
        for name in ("cut", "later"):
            entry = row(wall, name)
            entry.wait_for()
            assert entry.get_attribute("data-state") == "damaged", entry.inner_text()
            assert entry.locator(".why").inner_text() != ""
            button(entry, "Good").click()
            wait_for_text(panel, f"{name} was not marked")
            button(entry, "Watch").click()
            wait_for_text(wall.page.locator("#connection"), "This dataset is not shown")
            # No live image is taken for one of the dataset.
            assert wall.page.locator("section.tile").count() == 0
            wall.page.get_by_text("Back to live", exact=True).click()
            wall.wait_for_image("still/color")
    finally:
        for copy in (cut, later):
            shutil.rmtree(copy, ignore_errors=True)


def test_one_that_is_being_recorded_says_so(wall: Wall, folder: Path) -> None:
    open_panel(wall, "l", "Recordings")
    start(wall)
    entry = wall.page.locator('li.recording[data-state="recording"]')
    entry.wait_for()
    assert "Being recorded" in entry.inner_text()
    assert button(entry, "Watch").is_disabled()
    stop(wall)
    entry.wait_for(state="detached")


def test_redo_and_bad_need_two_presses_and_delete_nothing(wall: Wall, folder: Path) -> None:
    before = datasets(folder)
    start(wall)
    press(wall, "r")
    wait_for_text(wall.page.locator("#take-said"), "Press R again")
    assert wall.state("#record-state") == "recording"
    # A first press of another key is none of this one.
    press(wall, "b")
    wait_for_text(wall.page.locator("#take-said"), "Press B again")
    press(wall, "r", "r")
    until(lambda: len(datasets(folder)) == len(before) + 2, lambda: datasets(folder))
    wall.wait_for_state("#record-state", "recording")
    first, second = datasets(folder)[-2:]
    assert session(first)["mark"] == "bad"
    # The status may say that it records before the start is answered.
    until(lambda: wall.page.is_enabled("#start-stop"), wall.record_text)
    press(wall, "b", "b")
    wall.wait_for_state("#record-state", "idle")
    until(lambda: session(second).get("mark") == "bad", lambda: session(second))
    wait_for_text(wall.page.locator("#take-said"), "not deleted")
    # Of the last one: good at once, bad twice, and back.
    press(wall, "g")
    until(lambda: session(second).get("mark") == "good", lambda: session(second))
    wait_for_text(wall.page.locator("#take-said"), "Marked good")
    press(wall, "b")
    wait_for_text(wall.page.locator("#take-said"), "Press B again")
    assert session(second)["mark"] == "good"
    press(wall, "b")
    until(lambda: session(second).get("mark") == "bad", lambda: session(second))
    wall.page.click("#take-undo")
    until(lambda: session(second).get("mark") is None, lambda: session(second))
    assert len(datasets(folder)) == len(before) + 2
    # B asked about the running recording is no first press about the last one.
    start(wall)
    press(wall, "b")
    stop(wall)
    press(wall, "b")
    wait_for_text(wall.page.locator("#take-said"), "the last recording is marked bad")
    assert session(datasets(folder)[-1]).get("mark") is None


def test_a_countdown_can_be_cancelled(wall: Wall, folder: Path) -> None:
    count = len(datasets(folder))
    wall.page.select_option("#countdown", "3")
    wall.page.evaluate("document.activeElement.blur()")
    until(lambda: wall.page.is_enabled("#start-stop"), wall.record_text)
    for cancel in ("Escape", "Space"):
        press(wall, "Space")
        wait_for_text(wall.page.locator("#start-stop"), "Cancel (")
        press(wall, cancel)
        wait_for_text(wall.page.locator("#start-stop"), "Start")
    # Into a text field too, and over a reload.
    wall.page.reload()
    wall.wait_for_state("#connection", "live")
    until(lambda: wall.page.is_enabled("#start-stop"))
    assert wall.page.input_value("#countdown") == "3"
    press(wall, "Space")
    wait_for_text(wall.page.locator("#start-stop"), "Cancel (")
    wall.page.focus("#notes")
    press(wall, "Escape")
    wait_for_text(wall.page.locator("#start-stop"), "Start")
    time.sleep(3.5)
    assert len(datasets(folder)) == count
    wall.page.evaluate("document.activeElement.blur()")
    started = time.monotonic()
    start(wall)
    assert time.monotonic() - started >= 3.0
    stop(wall)
    assert len(datasets(folder)) == count + 1


def test_before_a_start_the_page_says_whether_the_rig_is_ready(wall: Wall) -> None:
    def said() -> list[str] | None:
        """The text, once it is about streams or sets, and the state that came with it."""
        text, state = wall.page.eval_on_selector("#ready", "ready => [ready.innerText, ready.dataset.state]")
        return [text, state] if "4 streams" in text or "sets within" in text else None

    text, state = until(said, wall.record_text)
    assert "doctor" in text or state != "go"


def test_after_a_click_on_a_panel_or_the_help_the_key_still_records(wall: Wall) -> None:
    """A panel and a dialog give the focus back when they are closed: not to a button that a pointer pressed, which Space would press again."""
    wall.page.click("button[data-panel=sync]")
    wall.page.wait_for_selector("#panel .sync")
    wall.page.keyboard.press("Escape")
    wall.page.wait_for_selector("#panel", state="hidden")
    wall.page.click("#show-help")
    wall.page.wait_for_selector("#help", state="visible")
    wall.page.keyboard.press("Escape")
    wall.page.wait_for_selector("#help", state="hidden")
    start(wall)
    wall.page.click("button[data-panel=sync]")
    wall.page.click("#panel-close")
    stop(wall)
    # By keyboard the focus comes back to where it was.
    wall.focus_by_keyboard("button[data-panel=sync]")
    wall.page.keyboard.press("Enter")
    wall.page.wait_for_selector("#panel .sync")
    wall.page.keyboard.press("Escape")
    wall.wait_for("() => document.activeElement === document.querySelector('button[data-panel=sync]')")


# A key in the moment in which Help closes: the button in it has the focus until the next image of the page is drawn.
KEY_AT_CLOSE = """() => {
    const help = document.querySelector("#help");
    help.showModal();
    help.close();
    const focused = document.activeElement;
    focused.dispatchEvent(new KeyboardEvent("keydown", { key: " ", bubbles: true, cancelable: true }));
    return focused.closest("dialog") !== null;
}"""


def test_a_key_in_the_moment_in_which_help_closes_records(wall: Wall) -> None:
    until(lambda: wall.page.is_enabled("#start-stop"), wall.record_text)
    assert wall.page.evaluate(KEY_AT_CLOSE)
    until(lambda: wall.state("#record-state") == "recording", wall.record_text)
    stop(wall)


def test_every_stream_is_in_the_table_of_the_synchronisation(wall: Wall) -> None:
    panel = open_panel(wall, "y", "Synchronisation")
    heads = panel.locator("tbody th")
    # One stream of each camera is in the table of the cameras too.
    rows = sorted([*STREAMS, "front/color", "still/color"])
    until(lambda: sorted(heads.all_inner_texts()) == rows, heads.all_inner_texts)
    medians = panel.locator("tbody").first.locator("tr td:nth-child(2)")
    number = re.compile(r"[+-]?\d+\.\d")
    until(lambda: all(number.fullmatch(text) for text in medians.all_inner_texts()), medians.all_inner_texts)


def test_doctor_shows_what_the_api_found(wall: Wall, rig: Address) -> None:
    # The same answer: what the next one finds may differ.
    with wall.page.expect_response("**/v1/doctor") as answer:
        panel = open_panel(wall, "d", "Doctor")
    until(lambda: wall.state(".doctor") in ("good", "info", "warning", "error"), panel.inner_text)
    for finding in answer.value.json()["findings"]:
        assert finding["why"] in panel.inner_text()
        assert finding["cure"] in panel.inner_text()
    # The rig that answers is no rig that is in its own way.
    assert "runs already" not in panel.inner_text()
    wait_for_text(wall.page.locator("#ready"), "doctor")
    save_screenshot(wall, "doctor")


def gain(wall: Wall) -> Locator:
    """The field of the gain of the simulated camera."""
    return wall.page.locator('.camera-controls[data-camera="front"] .control[data-name="gain"] input[type="number"]')


def set_gain(wall: Wall, value: int) -> None:
    gain(wall).fill(str(value))
    press(wall, "Enter")


def gain_in(answer: dict[str, Any]) -> Any:
    (front,) = (camera for camera in answer["cameras"] if camera["camera"] == "front")
    return next(control["value"] for control in front["controls"] if control["name"] == "gain")


def gain_in_file(folder: Path) -> Any:
    return tomllib.loads((folder / "panels.toml").read_text())["camera"][0].get("gain")


def written(wall: Wall) -> Locator:
    """The question before the rig file is written."""
    button(wall.page.locator("#panel-body"), "Write to rig file…").click()
    dialog = wall.page.locator("#save-controls")
    dialog.wait_for()
    return dialog


def test_a_control_takes_effect_at_once_and_comes_to_the_other_page(browser: Browser, rig: Address) -> None:
    with opened(browser, rig) as one, opened(browser, rig) as two:
        for wall in (one, two):
            open_panel(wall, "c", "Camera controls")
            gain(wall).wait_for()
        for value in (40, 60):
            set_gain(one, value)
            until(lambda value=value: gain_in(ask(rig, "GET", "/v1/controls")) == value)
            start = time.monotonic()
            until(lambda value=value: gain(two).input_value() == str(value), gain(two).input_value)
            took = time.monotonic() - start
            print(f"the other page had {value} after {took:.2f} s")
            assert took < OTHER_PAGE_S + SLACK_S
        # The image is as bright as the gain makes it.
        set_gain(one, 128)
        until(lambda: min(one.colors("front/color", NEAR)[0]) >= 250, lambda: one.colors("front/color", NEAR))
        set_gain(one, 16)
        until(lambda: min(one.colors("front/color", NEAR)[0]) < 200, lambda: one.colors("front/color", NEAR))
        # Both at once: they end with the same, which is what the camera has.
        set_gain(one, 70)
        set_gain(two, 80)

        def agree() -> bool:
            now = str(gain_in(ask(rig, "GET", "/v1/controls")))
            return gain(one).input_value() == gain(two).input_value() == now

        until(agree)
        save_screenshot(one, "controls")


def test_the_slider_sets_the_newest_value(wall: Wall, rig: Address) -> None:
    open_panel(wall, "c", "Camera controls")
    slider = wall.page.locator('.camera-controls[data-camera="front"] .control[data-name="gain"] input[type="range"]')
    slider.wait_for()
    slider.focus()
    press(wall, "Home")
    until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 16)
    for _ in range(9):
        press(wall, "ArrowRight")
    until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 25)
    wall.page.wait_for_timeout(2500)
    assert slider.input_value() == gain(wall).input_value() == "25"
    # Keys of the page and of the slider do not mix.
    assert wall.state("#record-state") == "idle"


def test_a_value_that_is_refused_is_said_and_taken_back(wall: Wall, rig: Address) -> None:
    panel = open_panel(wall, "c", "Camera controls")
    gain(wall).wait_for()
    before = gain_in(ask(rig, "GET", "/v1/controls"))
    set_gain(wall, 9999)
    wait_for_text(panel, "front, gain: ")
    until(lambda: gain(wall).input_value() == str(before), gain(wall).input_value)


def test_the_rig_file_is_written_after_a_look_at_the_difference(wall: Wall, folder: Path, rig: Address) -> None:
    panel = open_panel(wall, "c", "Camera controls")
    gain(wall).wait_for()
    before = gain_in_file(folder)
    set_gain(wall, 33)
    until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 33)
    dialog = written(wall)
    wait_for_text(dialog, "+gain = 33")
    save_screenshot(wall, "difference")
    press(wall, "Escape")
    dialog.wait_for(state="hidden")
    assert gain_in_file(folder) == before
    assert wall.page.is_visible("#panel")
    dialog = written(wall)
    wait_for_text(dialog, "+gain = 33")
    button(dialog, "Write").click()
    dialog.wait_for(state="hidden")
    assert gain_in_file(folder) == 33
    wait_for_text(panel, "Written to")

    # A change that is not wanted, back to the file.
    set_gain(wall, 99)
    wait_for_text(panel, "1 not as in the rig file")
    panel.get_by_text("Back to the rig file", exact=True).first.click()
    until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 33)
    until(lambda: gain(wall).input_value() == "33", gain(wall).input_value)


def test_a_difference_that_is_old_is_not_written(browser: Browser, rig: Address, folder: Path) -> None:
    with opened(browser, rig) as one, opened(browser, rig) as two:
        for wall in (one, two):
            open_panel(wall, "c", "Camera controls")
            gain(wall).wait_for()
        before = gain_in_file(folder)
        set_gain(one, 44)
        until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 44)
        dialog = written(two)
        wait_for_text(dialog, "+gain = 44")
        set_gain(one, 55)
        until(lambda: gain_in(ask(rig, "GET", "/v1/controls")) == 55)
        button(dialog, "Write").click()
        wait_for_text(dialog, "Not written: the rig file or a control has changed since")
        wait_for_text(dialog, "+gain = 55")
        assert gain_in_file(folder) == before
        button(dialog, "Write").click()
        dialog.wait_for(state="hidden")
        assert gain_in_file(folder) == 55


CAPTURE = {
    "out": f"views {MARKUP}",
    "is_finished": False,
    "refused": [f"front: {MARKUP}"],
    "progress": {
        "state": "hold_still",
        "views": 7,
        "cameras": [
            {
                "name": "front",
                "corners": 2,
                "at": [[0.5, 0.5], [0.6, 0.5]],
                "views": 7,
                "coverage": [0, 3, 0, 9],
                "coverage_columns": 2,
                "worst_px": 0.72,
                "missing": [f"7 of 12 views {MARKUP}"],
            }
        ],
        "pairs": [],
        "missing": [],
        "hint": {
            "text": f"to the top left {MARKUP}",
            "camera": "front",
            "seen_by": ["front"],
            "outline": [[0.1, 0.1], [0.4, 0.1], [0.4, 0.4], [0.1, 0.4]],
            "distance_m": 0.8,
            "tilt": None,
            "gain": 0.2,
        },
    },
}
# Whether something is drawn over the image at this place.
DRAWN = """([x, y]) => {
    const canvas = document.querySelector('section.tile[data-stream="front/color"] canvas.board');
    const pixel = canvas?.getContext("2d").getImageData(x * canvas.width, y * canvas.height, 1, 1);
    return pixel !== undefined && pixel.data[3] > 0;
}"""


def test_a_capture_of_views_is_followed_on_the_images(wall: Wall, rig: Address) -> None:
    panel = open_panel(wall, "k", "Calibration")
    wait_for_text(panel, "Not calibrated")

    def post(**more: Any) -> None:
        ask(rig, "POST", "/v1/calibration/events", {**CAPTURE, "utc_ns": time.time_ns(), **more})

    post()
    wait_for_text(panel, "Hold still")
    assert panel.inner_text().count(MARKUP) == 3
    # A corner, covered parts, the outline; not the middle of a part that is not covered.
    places = ((0.5, 0.5, True), (0.75, 0.25, True), (0.75, 0.75, True), (0.1, 0.1, True), (0.25, 0.75, False))
    for x, y, is_drawn in places:
        assert wall.page.evaluate(DRAWN, [x, y]) == is_drawn, f"{x} {y}"
    save_screenshot(wall, "capture")
    # What is drawn goes with the panel, and with the capture.
    press(wall, "Escape")
    assert wall.page.locator("canvas.board").count() == 0
    press(wall, "k")
    until(lambda: wall.page.locator("canvas.board").count() == 1)
    post(is_finished=True)
    wait_for_text(panel, "Last capture")
    assert wall.page.locator("canvas.board").count() == 0


def test_the_panels_survive_the_end_of_the_daemon(browser: Browser, binary: str, runtime: Path, folder: Path) -> None:
    rig = folder / "ends.toml"
    text = RIG.format(name="ends", port=free_port()).replace("datasets", "none")
    rig.write_text(text + SIMULATED.format(name="front"))
    with running(binary, runtime, folder / "ends.log", "run", str(rig), codes=CODES) as daemon:
        where = address(binary, runtime, "ends")
        with opened(browser, where) as wall:
            wall.wait_for_image("front/color")
            wait_for_text(open_panel(wall, "l", "Recordings"), "No recordings in")
            press(wall, "c")
            daemon.kill()
            wall.wait_for_state("#connection", "lost")
            for key, title, text in (
                ("l", "Recordings", "does not answer"),
                ("d", "Doctor", "does not answer"),
                ("k", "Calibration", "does not answer"),
                ("c", "Camera controls", "does not answer"),
                ("y", "Synchronisation", ""),
            ):
                wait_for_text(open_panel(wall, key, title), text)
            press(wall, "Space", "r", "b", "g", "m")
            wall.page.wait_for_timeout(300)
            assert wall.state("#record-state") == "idle"


def test_without_the_token_the_panels_show_nothing(browser: Browser, rig: Address) -> None:
    with blank(browser, rig.origin) as wall:
        wall.open(f"{rig.origin}/#token={'0' * 64}")
        wall.wait_for_state("#connection", "denied")
        for key, title in (("l", "Recordings"), ("d", "Doctor"), ("c", "Camera controls"), ("k", "Calibration")):
            wait_for_text(open_panel(wall, key, title), "token")
        assert wall.page.locator("li.recording").count() == 0


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not in tests/readers/node_modules; make test puts it there")
def test_no_serious_violation_of_accessibility_in_the_panels(wall: Wall, rig: Address) -> None:
    record(rig)
    wall.page.evaluate(AXE.read_text() + "; undefined")
    found = []
    panels = {"l": "li.recording", "y": ".sync tbody tr", "d": ".report h3", "c": ".control", "k": ".finding"}
    for key, selector in panels.items():
        press(wall, key)
        wall.page.wait_for_selector(selector)
        found += violations(wall, key)
    start(wall)
    found += violations(wall, "recording")
    stop(wall)
    assert found == []


def test_the_list_of_recordings_is_used_with_the_keyboard(wall: Wall, rig: Address) -> None:
    newest = [record(rig, 1.0), record(rig, 1.0)][::-1]
    open_panel(wall, "l", "Recordings")
    row(wall, newest[0]).wait_for()
    wall.page.focus(f'li.recording[data-name="{newest[0]}"] .mark-good')
    press(wall, "ArrowDown")
    focused = "() => document.activeElement.closest('li')?.dataset.name"
    assert wall.page.evaluate(focused) == newest[1]
    # Space presses the button that has the focus, and starts no recording.
    wall.wait_for_state("#record-state", "idle")
    press(wall, "Space")
    until(lambda: button(row(wall, newest[1]), "Good").get_attribute("aria-pressed") == "true")
    assert wall.page.evaluate(focused) == newest[1]
    # As long as a start would need to show.
    wall.page.wait_for_timeout(1000)
    assert wall.state("#record-state") == "idle"
    press(wall, "Escape")
    assert not wall.page.locator("#panel").is_visible()
    assert wall.state("#connection") == "live"
