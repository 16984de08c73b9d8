"""What the live page can do with the rig behind it: recordings, doctor's findings, controls, and datasets in place of cameras.

Each answer is held against the API's own description by a validator that is not ours (`jsonschema`).
"""

from __future__ import annotations

import http.client
import io
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, urlsplit

import depthrig
import jsonschema
import numpy as np
import pytest
from page import SIMULATED, address, files_camera, pattern, until
from PIL import Image
from test_daemon import ROOT, WAIT_S, binary, command, running, runtime
from test_live import Page, closed
from websockets.sync.client import connect

__all__ = ["binary", "runtime"]

OPENAPI = json.loads((ROOT / "daemon" / "src" / "api" / "openapi.json").read_text())
RIG = """# A rig of two.
rig = "lab"
[recording]
directory = "datasets"
color = "raw"
reserve_mb = 64
"""
FAULT = """[[camera.fault]]
kind = "unplug"
at_s = 0.5
duration_s = 0.5
"""


@dataclass
class Rig:
    """A running rig and its API, over the port, as the page has it."""

    origin: str
    token: str
    folder: Path
    routes: set[tuple[str, str]] = field(default_factory=set)

    @property
    def file(self) -> Path:
        return self.folder / "lab.toml"

    def ask(self, method: str, path: str, body: dict | None = None, code: int = 200) -> dict:
        """The answer as JSON; it is what the description says."""
        status, headers, data = self.request(method, path, body, {"Authorization": f"Bearer {self.token}"})
        assert status == code, (path, data)
        answer = json.loads(data) if data else {}
        self.validate(method, path.partition("?")[0], status, headers["content-type"], answer)
        return answer

    def request(
        self, method: str, path: str, body: dict | None, headers: dict[str, str]
    ) -> tuple[int, dict[str, str], bytes]:
        where = urlsplit(self.origin)
        connection = http.client.HTTPConnection(where.hostname or "", where.port or 0, timeout=WAIT_S)
        data = None if body is None else json.dumps(body)
        if data is not None:
            headers = {**headers, "Content-Type": "application/json"}
        connection.request(method, path, data, headers)
        answer = connection.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()

    def validate(self, method: str, path: str, status: int, media: str, answer: dict) -> None:
        call = OPENAPI["paths"][path][method.lower()]
        schema = call["responses"][str(status)]["content"][media]["schema"]
        jsonschema.Draft202012Validator({**schema, "components": OPENAPI["components"]}).validate(answer)

    def record(self, seconds: float = 1.0, **stop: str) -> dict:
        self.ask("POST", "/v1/record/start", {"scene": "table <b>"})
        time.sleep(seconds)
        until(lambda: self.ask("GET", "/v1/status")["recording"]["sets"] >= 4)
        return self.ask("POST", "/v1/record/stop", dict(stop))

    @contextmanager
    def page(self, watched: list[dict], dataset: str | None = None) -> Iterator[Page]:
        query = "" if dataset is None else f"?dataset={quote(dataset)}"
        url = self.origin.replace("http", "ws") + "/v1/live" + query
        with connect(url, max_size=None) as socket:
            page = Page(socket, [])
            page.say(token=self.token)
            page.hello = page.text("hello")
            page.watch(watched)
            yield page


@pytest.fixture(scope="module")
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("lab")
    (folder / "lab.toml").write_text(RIG + SIMULATED.format(name="front") + FAULT + files_camera("still", pattern(folder / "still")))
    with running(binary, runtime, folder / "log", "run", str(folder / "lab.toml"), "-q"):
        where = address(binary, runtime, "lab")
        rig = Rig(where.origin, where.token, folder)

        def cameras() -> list[dict]:
            return rig.ask("GET", "/v1/status")["cameras"]

        # The fault of the camera in front is over.
        until(
            lambda: all(c["state"] == "streaming" for c in cameras()) and cameras()[0]["reconnects"] >= 1,
            lambda: json.dumps(cameras(), indent=1),
        )
        yield rig


@pytest.fixture(scope="module")
def recordings(rig: Rig) -> list[str]:
    """The names of two recordings, the older one first."""
    names = []
    for _ in range(2):
        names.append(Path(rig.record(1.5)["path"]).name)
        time.sleep(1.0)
    return names


def listed(rig: Rig, name: str) -> dict:
    (found,) = [r for r in rig.ask("GET", "/v1/recordings")["recordings"] if r["name"] == name]
    return found


def test_recordings_are_listed_shown_and_judged(rig: Rig, recordings: list[str], binary: str, runtime: Path) -> None:
    answer = rig.ask("GET", "/v1/recordings")
    assert answer["directory"] == str(rig.folder / "datasets") and answer["more"] == 0
    assert [r["name"] for r in answer["recordings"]][:2] == recordings[::-1]
    newest = answer["recordings"][0]
    assert (newest["health"], newest["scene"], newest["mark"]) == ("whole", "table <b>", None)
    assert newest["sets"] >= 4 and newest["streams"] == 4
    headers = {"Authorization": f"Bearer {rig.token}"}
    status, _, jpeg = rig.request("GET", f"/v1/recordings/image?name={quote(newest['name'])}", None, headers)
    assert status == 200
    with Image.open(io.BytesIO(jpeg)) as image:
        assert image.format == "JPEG" and image.size == (320, 240)
    # A judgement is in the file, with its history, and can be taken back.
    for mark in ("bad", "good", None):
        name = recordings[0]
        assert rig.ask("POST", "/v1/recordings/mark", {"name": name, "mark": mark})["mark"] == mark
        assert listed(rig, name)["mark"] == mark
    history = json.loads(command(binary, runtime, "edit", str(rig.folder / "datasets" / recordings[0]), "--json"))
    changes = [(e["field"], e["before"], e["after"]) for e in history["history"]]
    assert changes == [("mark", "", "bad"), ("mark", "bad", "good"), ("mark", "good", "")]
    command(binary, runtime, "verify", str(rig.folder / "datasets" / recordings[0]), codes=(0, 3))


def test_what_is_marked_bad_is_not_exported(rig: Rig, recordings: list[str], binary: str, runtime: Path) -> None:
    bad = Path(rig.record(1.0, mark="bad")["path"])
    assert listed(rig, bad.name)["mark"] == "bad"
    good = rig.folder / "datasets" / recordings[1]
    out = rig.folder / "exported"
    command(binary, runtime, "export", "bytecameradepth", str(bad), str(good), str(out), "--json")
    assert recordings[1] in (out / "export.json").read_text()
    assert bad.name not in (out / "export.json").read_text()
    refused = command(
        binary, runtime, "export", "bytecameradepth", str(bad), str(rig.folder / "none"), codes=(2,)
    )
    assert not (rig.folder / "none").exists(), refused


def test_a_report_opens_without_the_token_at_an_address_of_its_own(rig: Rig, recordings: list[str]) -> None:
    until(lambda: listed(rig, recordings[0])["has_report"])
    first = rig.ask("POST", "/v1/recordings/report", {"name": recordings[0]})["path"]
    second = rig.ask("POST", "/v1/recordings/report", {"name": recordings[0]})["path"]
    assert first != second
    status, headers, html = rig.request("GET", first, None, {})
    assert status == 200 and b"<html" in html and headers["content-type"].startswith("text/html")
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "sandbox" in headers["content-security-policy"]
    status, _, _ = rig.request("GET", first[:-1] + ("0" if first[-1] != "0" else "1"), None, {})
    assert status == 404


@pytest.mark.parametrize("name", ["", ".", "..", "../lab.toml", "/etc", "none", "a/../../..", "\0"])
def test_no_name_leads_out_of_the_folder_of_recordings(rig: Rig, recordings: list[str], name: str) -> None:
    rig.ask("POST", "/v1/recordings/mark", {"name": name, "mark": "bad"}, 404)
    rig.ask("POST", "/v1/recordings/report", {"name": name}, 404)
    rig.ask("GET", f"/v1/recordings/image?name={quote(name)}", code=404)


def test_a_recording_that_goes_on_is_said_to(rig: Rig) -> None:
    path = Path(rig.ask("POST", "/v1/record/start", {})["path"])
    try:
        entry = listed(rig, path.name)
        assert entry["health"] == "recording" and entry["why"] == []
        rig.ask("POST", "/v1/recordings/mark", {"name": path.name, "mark": "bad"}, 400)
        assert rig.ask("GET", "/v1/status")["recording"]["closing"] is False
    finally:
        assert rig.ask("POST", "/v1/record/stop", {})["closing"] is False


def test_the_skew_of_each_stream_is_told(rig: Rig) -> None:
    until(lambda: rig.ask("GET", "/v1/status")["sets"]["skews"])
    sets = rig.ask("GET", "/v1/status")["sets"]
    assert {s["stream"] for s in sets["skews"]} == {f"{c}/{s}" for c in ("front", "still") for s in ("color", "depth")}
    # No frame is further from its tick than half the longest period.
    assert all(abs(s["median_ms"]) <= s["p95_ms"] + 0.001 <= 51 for s in sets["skews"])


def test_the_doctor_examines_the_running_rig(rig: Rig) -> None:
    answer = rig.ask("GET", "/v1/doctor")
    assert answer["rig"] == "lab" and answer["verdict"] in ("good", "info", "warning", "error")
    assert [c["name"] for c in answer["cameras"]] == ["front", "still"]
    assert isinstance(answer["attached"]["cameras"], list)


def camera_controls(rig: Rig, name: str) -> dict:
    (found,) = [c for c in rig.ask("GET", "/v1/controls")["cameras"] if c["camera"] == name]
    return found


def test_a_control_takes_effect_at_once_and_reaches_the_file_only_when_confirmed(
    rig: Rig, binary: str, runtime: Path
) -> None:
    before = rig.file.read_text()
    assert rig.ask("GET", "/v1/controls/changes")["diff"] == ""
    (gain,) = camera_controls(rig, "front")["controls"]
    assert (gain["name"], gain["minimum"], gain["maximum"], gain["value"]) == ("gain", 16, 128, 16)
    assert gain["in_file"] is None
    color = depthrig.Stream("front/color", runtime_dir=runtime, timeout=WAIT_S)

    def shown(value: int) -> bool:
        frame = color.next(timeout=WAIT_S)
        return frame is not None and frame.header.gain == value

    recording = rig.ask("POST", "/v1/record/start", {})
    (gain,) = rig.ask("POST", "/v1/controls", {"camera": "front", "name": "gain", "value": 64})["controls"]
    assert gain["value"] == 64
    until(lambda: shown(64))
    rig.ask("POST", "/v1/record/stop", {})
    session = (Path(recording["path"]) / "session.toml").read_text()
    assert "control changed: front.gain = 64" in session
    # The next one says how it began.
    session = (Path(rig.record(0.5)["path"]) / "session.toml").read_text()
    assert "controls changed before: front.gain = 64" in session
    changes = rig.ask("GET", "/v1/controls/changes")
    assert [line for line in changes["diff"].splitlines() if line.startswith("+")][1:] == ["+gain = 64"]
    assert rig.file.read_text() == before
    rig.ask("POST", "/v1/controls/save", {"fingerprint": "0"}, 409)
    # Somebody else edits the file meanwhile.
    rig.file.write_text(before + "# by hand\n")
    rig.ask("POST", "/v1/controls/save", {"fingerprint": changes["fingerprint"]}, 409)
    changes = rig.ask("GET", "/v1/controls/changes")
    rig.ask("POST", "/v1/controls/save", {"fingerprint": changes["fingerprint"]})
    after = rig.file.read_text()
    assert after.replace("gain = 64\n", "") == before + "# by hand\n"
    command(binary, runtime, "config", "check", str(rig.file))
    assert rig.ask("GET", "/v1/controls/changes")["diff"] == ""
    assert camera_controls(rig, "front")["controls"][0]["in_file"] == 64
    # A value that is there already changes between its spaces and its comment.
    rig.file.write_text(after.replace("gain = 64\n", "gain   = 64  # for the lamps\n"))
    rig.ask("POST", "/v1/controls", {"camera": "front", "name": "gain", "value": 80})
    changes = rig.ask("GET", "/v1/controls/changes")
    rig.ask("POST", "/v1/controls/save", {"fingerprint": changes["fingerprint"]})
    assert rig.file.read_text() == after.replace("gain = 64\n", "gain   = 80  # for the lamps\n")
    rig.file.write_text(after)
    # Back to the file, and without a value there back to what it is after power-on.
    rig.ask("POST", "/v1/controls", {"camera": "front", "name": "gain", "value": 32})
    assert rig.ask("POST", "/v1/controls/revert", {"camera": "front"})["controls"][0]["value"] == 64
    until(lambda: shown(64))
    rig.file.write_text(before)
    rig.ask("POST", "/v1/controls", {"camera": "front", "name": "gain", "value": 32})
    assert rig.ask("POST", "/v1/controls/revert", {"camera": "front"})["controls"][0]["value"] == 16
    until(lambda: shown(16))


def test_brightness_follows_the_gain(rig: Rig, runtime: Path) -> None:
    color = depthrig.Stream("front/color", runtime_dir=runtime, timeout=WAIT_S)
    means = []
    for gain in (16, 32):
        rig.ask("POST", "/v1/controls", {"camera": "front", "name": "gain", "value": gain})

        def mean(gain: int = gain) -> float:
            frame = color.next(timeout=WAIT_S)
            assert frame is not None
            return float(np.mean(frame.array)) if frame.header.gain == gain else 0.0

        means.append(until(mean))
    rig.ask("POST", "/v1/controls/revert", {"camera": "front"})
    assert means[1] > 1.2 * means[0]


def test_controls_that_cannot_be_changed_are_refused_with_the_reason(rig: Rig) -> None:
    still = camera_controls(rig, "still")
    assert still["controls"] == [] and "rig file" in still["problem"]
    ask = {"camera": "front", "name": "gain", "value": 16}
    for change, code in (
        ({"camera": "nobody"}, 404),
        ({"name": "brightness"}, 400),
        ({"value": 15}, 400),
        ({"value": 129}, 400),
        ({"value": True}, 400),
        ({"value": 16.5}, 400),
        ({"camera": "still"}, 409),
    ):
        rig.ask("POST", "/v1/controls", {**ask, **change}, code)
    assert camera_controls(rig, "front")["controls"][0]["value"] == 16


def test_a_recording_is_shown_in_place_of_the_cameras(
    rig: Rig, recordings: list[str], binary: str, runtime: Path
) -> None:
    watched = [{"stream": "still/depth", "width": 0, "rate_hz": 60}]
    sent_before = rig.ask("GET", "/v1/status")["sets"]["sent"]
    with rig.page(watched, recordings[0]) as page:
        assert page.hello["is_replay"] is True and page.hello["dataset"] == recordings[0]
        image = page.image()
        expected = Image.open(rig.folder / "still" / "depth_1.png")
        np.testing.assert_array_equal(image.depth, np.asarray(expected))
        page.say(replay={"pause": {}})

        def status(true: str, value: object) -> dict:
            until(lambda: (now := page.text("status")["replay"])[true] == value, lambda: now_of(page))
            return page.text("status")["replay"]

        length = status("paused", True)["length_sets"]
        assert length >= 4
        page.say(replay={"seek": {"set": 2}})
        assert status("set", 2)["paused"]
        page.say(replay={"step": {"sets": -1}})
        status("set", 1)
        page.say(replay={"loop": {"on": True}})
        status("loop", True)
        page.say(replay={"rate": {"rate": 2.0}})
        status("rate", 2.0)
        page.say(replay={"rate": {"rate": 100.0}})
        assert "100" in page.text("problem")["message"]
        # Another page sees the same, and one more dataset has to wait.
        with rig.page(watched, recordings[0]) as other:
            assert other.text("status")["replay"]["set"] == 1
        url = rig.origin.replace("http", "ws") + f"/v1/live?dataset={quote(recordings[1])}"
        with connect(url) as socket:
            socket.send(json.dumps({"token": rig.token}))
            code, reason = closed(socket)
            assert code == 4404 and "another page shows" in reason
        page.say(replay={"resume": {}})
        first = page.image().sequence
        assert page.image().sequence != first
    # The rig went on meanwhile, and its own page cannot be steered so.
    assert rig.ask("GET", "/v1/status")["sets"]["sent"] > sent_before
    with rig.page(watched) as page:
        assert "dataset" not in page.hello and page.hello["is_replay"] is False
        page.say(replay={"pause": {}})
        assert "no recording" in page.text("problem")["message"]
    # Now the other one is shown.
    until(lambda: shows(rig, recordings[1]))


def now_of(page: Page) -> object:
    return page.text("status")["replay"]


def shows(rig: Rig, name: str) -> bool:
    url = rig.origin.replace("http", "ws") + f"/v1/live?dataset={quote(name)}"
    with connect(url) as socket:
        socket.send(json.dumps({"token": rig.token}))
        try:
            return "hello" in json.loads(socket.recv(WAIT_S))
        except Exception:
            return False


@pytest.mark.parametrize("name", ["none", "../lab.toml", "", "still"])
def test_what_is_no_recording_is_not_shown(rig: Rig, recordings: list[str], name: str) -> None:
    with connect(rig.origin.replace("http", "ws") + f"/v1/live?dataset={quote(name)}") as socket:
        socket.send(json.dumps({"token": rig.token}))
        code, reason = closed(socket)
        assert code == 4404 and reason


def test_a_wrong_token_sees_no_recording(rig: Rig, recordings: list[str]) -> None:
    with connect(rig.origin.replace("http", "ws") + f"/v1/live?dataset={quote(recordings[0])}") as socket:
        socket.send(json.dumps({"token": "0" * 64}))
        assert closed(socket)[0] == 4401


def test_shared_memory_is_free_again_when_nobody_looks(rig: Rig, recordings: list[str]) -> None:
    process_id = rig.ask("GET", "/v1/status")["pid"]

    def mapped() -> int:
        """Pieces of shared memory that the daemon has."""
        maps = Path(f"/proc/{process_id}/maps").read_text().splitlines()
        return len({line.split()[-1] for line in maps if "/dev/shm/depthrig_" in line})

    # The dataset of the test before may still be on its way out.
    before = until(lambda: (now := mapped()) == (time.sleep(1.0), mapped())[1] and now)
    with rig.page([{"stream": "still/color", "width": 0, "rate_hz": 30}], recordings[0]) as page:
        page.image()
        assert mapped() > before
    until(lambda: mapped() <= before, lambda: (mapped(), before))
