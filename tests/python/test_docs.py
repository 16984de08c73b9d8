"""The site of the documents, built and opened in a browser; and what the documents claim, tried with the program."""

from __future__ import annotations

import functools
import http.client
import http.server
import json
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from page import CHROMIUM, SIMULATED, opened, until
from playwright.sync_api import sync_playwright
from test_daemon import ROOT, WAIT_S, binary, command, environment, running, runtime
from test_page import address, save_screenshot
from tutorial import TUTORIAL, Commands, blocks, leave, record, shell, watch

sys.path.insert(0, str(ROOT / "tools" / "docs"))
import links
import reference

__all__ = ["binary", "runtime"]

MDBOOK = ROOT / ".venv-docs" / "bin" / "mdbook"
CODES = (0, 3)
"""Frames may be lost on a small computer; that is not a matter of the documents."""


@pytest.fixture(scope="module")
def site(binary: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not MDBOOK.exists():
        pytest.skip("no mdBook; `make environments` installs it")
    out = tmp_path_factory.mktemp("docs") / "book"
    build = [sys.executable, ROOT / "tools/docs/build.py", "site", "--binary", binary, "--mdbook", MDBOOK, "--out", out]
    done = subprocess.run(build, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def text(page: Path) -> str:
    return re.sub(r"<[^>]+>", "", page.read_text()).replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", '"')


def test_the_reference_has_every_command(binary: str, site: Path, tmp_path: Path) -> None:
    subprocess.run([binary, "man", "--out", tmp_path], timeout=WAIT_S, check=True)
    pages = "\n".join(text(page) for page in (site / "docs/reference/commands").glob("*.html"))
    found = {line.replace(" ", "-") for line in re.findall(r"^ *(depthrig [a-z0-9 -]+)$", pages, re.MULTILINE)}
    missing = {page.stem for page in tmp_path.glob("depthrig-*.1")} - found
    assert not missing, missing
    assert len(list(tmp_path.glob("depthrig-*.1"))) > 50


def test_the_reference_has_the_rig_file_and_every_call_type_and_metric(
    binary: str, site: Path, runtime: Path, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('rig = "described"\n' + SIMULATED.format(name="front"))
    with running(binary, runtime, tmp_path / "log", "run", str(rig)):
        where = address(binary, runtime, "described")
        def get(path: str) -> str:
            connection = http.client.HTTPConnection("127.0.0.1", where.port, timeout=WAIT_S)
            connection.request("GET", path, headers={"Authorization": f"Bearer {where.token}"})
            return connection.getresponse().read().decode()

        metrics = re.findall(r"^# HELP (\S+)", get("/metrics"), re.MULTILINE)
        document = json.loads(get("/v1/openapi.json"))
    assert len(metrics) > 20
    shown = text(site / "docs/reference/metrics.html")
    assert [name for name in metrics if name not in shown] == []
    shown = text(site / "docs/reference/api.html")
    calls = [f"{method.upper()} {path}" for path, methods in document["paths"].items() for method in methods]
    assert [name for name in [*calls, *document["components"]["schemas"]] if name not in shown] == []
    shown = text(site / "docs/reference/rig-file.html")
    assert command(binary, runtime, "config", "show").strip() in shown


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")
def test_the_site_searches_and_loads_nothing_from_elsewhere(site: Path) -> None:
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=site)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        origin = f"http://127.0.0.1:{server.server_port}/"
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        page = browser.new_page()
        page.set_default_timeout(WAIT_S * 1000)
        requests: list[str] = []
        errors: list[str] = []
        page.on("request", lambda r: requests.append(r.url))
        page.on("pageerror", lambda e: errors.append(str(e)))
        page.goto(origin)
        assert page.inner_text("main h1") == "depthrig"
        page.keyboard.press("s")
        page.keyboard.type("hand-eye")
        page.click("#mdbook-searchresults a >> text=Calibration")
        page.wait_for_url("**/calibration.html*")
        page.goto(f"{origin}docs/live-page.html")
        assert page.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
        browser.close()
        server.shutdown()
    assert errors == []
    assert [url for url in requests if not url.startswith(origin)] == []


def test_every_command_in_the_documents_exists(binary: str) -> None:
    root = reference.command(Path(binary))
    seen = 0
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for line in shell(path):
            for part in re.split(r"\s*(?:&&|\|\|?|;)\s*", line):
                part = part.removeprefix("sudo ")
                if not re.match(r"depthrig(?![\w-])|\"\$\(command -v depthrig\)\"", part):
                    continue
                check(root, shlex.split(part)[1:], f"{path.name}: {line}")
                seen += 1
    assert seen > 40


def check(root: reference.Command, words: list[str], where: str) -> None:
    one = root
    for word in words:
        inner = {c.name.rpartition(" ")[2]: c for c in one.inner}
        if word in inner:
            one = inner[word]
        elif word.startswith("--"):
            option = word.partition("=")[0]
            assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", one.help), f"{where}: {one.name} has no {option}"
        elif one.inner and one.name != "depthrig replay":
            raise AssertionError(f"{where}: {one.name} has no command {word}")


def test_every_camera_in_the_documents_is_valid(binary: str, runtime: Path, tmp_path: Path) -> None:
    seen = 0
    for path in sorted((ROOT / "docs").rglob("*.md")):
        for example in blocks(path, "toml"):
            if not example.startswith("[[camera]]") or "\nbackend" not in example:
                continue
            rig = tmp_path / "rig.toml"
            rig.write_text('rig = "example"\n' + example)
            done = subprocess.run(
                [binary, "config", "check", rig], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
            )
            # An example may name files that only its reader has.
            is_fine = done.returncode == 0 or "No such file" in done.stderr
            assert is_fine, f"{path.name}:\n{example}\n{done.stdout}{done.stderr}"
            seen += 1
    assert seen >= 5


@pytest.fixture
def bench(binary: str, tmp_path: Path) -> Path:
    """An empty folder, from which the program is found by its name."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "depthrig").symlink_to(binary)
    return tmp_path


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; tools/setup.sh test installs it")
def test_the_tutorial_leads_to_a_dataset(binary: str, bench: Path, runtime: Path) -> None:
    commands = Commands()
    take = commands.take

    def sh(line: str, codes: tuple[int, ...] = (0,)) -> str:
        where = {**environment(runtime), "PATH": f"{bench / 'bin'}:{os.environ['PATH']}"}
        done = subprocess.run(["sh", "-c", line], cwd=bench, env=where, capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert done.returncode in codes, f"{line}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def python(example: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", example], env=environment(runtime), capture_output=True, text=True, timeout=WAIT_S, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    # One image of each scene instead of twelve: the rest of the rendering shows nothing new.
    rig = blocks(TUTORIAL, "toml")[0].replace("backend =", "poses = 1\nbackend =")
    (bench / "first.toml").write_text(f"{rig}\n[recording]\ndirectory = {json.dumps(str(bench / 'datasets'))}\nreserve_mb = 64\n")
    sh(take("depthrig --version"))
    sh(take("depthrig config check"))
    replayed, live = blocks(TUTORIAL, "python")
    with running(binary, runtime, bench / "log", *shlex.split(take("depthrig run"))[1:2], str(bench / "first.toml")):
        where = address(binary, runtime, "first")
        until(lambda: json.loads(sh("depthrig status --json", CODES))["preparing"] is None)
        until(lambda: "front/depth  streaming" in sh("depthrig status", CODES))
        assert "front/depth  streaming" in sh(take("depthrig status"), CODES)
        # A busy computer's newest image may be older than the tutorial allows.
        assert "ms old" in python(live.replace("max_age=0.3", "max_age=60"))
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM)
            with opened(browser, where) as wall:
                take("depthrig open")
                wall.wait_for_image("front/color", "front/depth", "left/color", "left/depth")
                record(wall, 3, lambda: save_screenshot(wall, "tutorial"))
                watch(wall, "front/color")
                leave(wall)
            browser.close()
        sh(take("depthrig record start").replace("10s", "2s").replace("kitchen", "again"), CODES)
        until(lambda: json.loads(sh("depthrig record status --json", CODES)).get("active") is not True)
    assert "kitchen" in sh(take("depthrig sessions"), CODES)
    assert re.search("whole|intact", sh(take("depthrig verify"), CODES))
    assert "front/depth" in sh(take("depthrig info"), CODES)
    sh(take("depthrig cat"))
    assert list((bench / "images").rglob("*.jpg")) + list((bench / "images").rglob("*.png"))
    dataset = next((bench / "datasets").glob("*_kitchen"))
    assert take("depthrig replay") == "depthrig replay datasets/*_kitchen --loop"
    with running(binary, runtime, bench / "replay", "replay", str(dataset), "--loop"):
        assert python(replayed).count("(480, 640)") == 5
    sh(take("depthrig cameras"))
    sh(take("depthrig doctor"), (0, 1, 3))
    # Not tried here: the second window, installing, and what watches a terminal (tests of their own).
    assert sorted(line.split()[1] for line in commands.left if line.startswith("depthrig")) == ["install", "open", "top"]
