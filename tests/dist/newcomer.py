"""A new user with the wheel, a browser and docs/tutorial.md: from `pip install` to the replay, with the seconds of each step.

    newcomer.py WHEEL HOME

Runs as the user it stands for. The commands are those of the tutorial, typed into two terminals that know nothing of this
checkout; only the browser is driven from here. Nothing is asserted about time: it is printed.
"""

from __future__ import annotations

import os
import pty
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "python"))
from page import CHROMIUM, Address, opened
from playwright.sync_api import sync_playwright
from terminal import take_terminal
from tutorial import SCENE, TUTORIAL, Commands, blocks, leave, record, watch

LIMIT_S = 1200.0
"""Only for what would otherwise hang."""
DONE = re.compile(r"\[done (\d+)\] $")
RENDERED = "() => document.querySelector('#preparing').textContent === ''"
STREAMS = ("front/color", "front/depth", "left/color", "left/depth")


class Terminal:
    """A terminal of the user, with a shell in it."""

    def __init__(self, folder: Path, env: dict[str, str]) -> None:
        self.keys, end = pty.openpty()
        shell = ["bash", "--norc", "--noprofile", "--noediting", "-i"]
        self.shell = subprocess.Popen(
            shell, cwd=folder, env=env, stdin=end, stdout=end, stderr=end, start_new_session=True, preexec_fn=take_terminal
        )
        os.close(end)
        self.shown = ""
        threading.Thread(target=self._read, daemon=True).start()
        self.wait()

    def _read(self) -> None:
        while True:
            try:
                text = os.read(self.keys, 1 << 16).decode(errors="replace")
            except OSError:
                return
            self.shown += text

    def start(self, line: str) -> None:
        """Types a line and does not wait for its end."""
        self.shown = ""
        os.write(self.keys, f"{line}\n".encode())

    def interrupt(self) -> None:
        """Presses Ctrl-C and waits for the end."""
        os.write(self.keys, b"\x03")
        self.wait()

    def wait(self) -> int:
        """The exit code of the line, when the shell asks for the next one."""
        deadline = time.monotonic() + LIMIT_S
        while (found := DONE.search(self.shown)) is None:
            assert time.monotonic() < deadline and self.shell.poll() is None, self.shown
            time.sleep(0.02)
        return int(found[1])

    def run(self, line: str, codes: tuple[int, ...] = (0,)) -> str:
        """Types a line; what it prints."""
        self.start(line)
        code = self.wait()
        assert code in codes, f"{line}: {code}\n{self.shown}"
        return self.shown


class Watch:
    """Prints how long each step took."""

    def __init__(self) -> None:
        self.begin = self.last = time.monotonic()

    def step(self, what: str) -> None:
        now = time.monotonic()
        print(f"{now - self.last:7.1f} s  {what}", flush=True)
        self.last = now


def machine() -> str:
    model = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return f"{os.cpu_count()} cores of {model[1] if model else 'an unknown processor'}, load {os.getloadavg()[0]:.1f}"


def desk(home: Path, wheel: Path) -> tuple[Path, dict[str, str]]:
    """An empty folder with the wheel in it, and the environment of a user whose browser writes down what it shall open."""
    folder = home / "first"
    folder.mkdir()
    shutil.copy(wheel, folder)
    programs = home / "bin"
    programs.mkdir()
    browser = programs / "xdg-open"
    browser.write_text(f'#!/bin/sh\nprintf %s "$1" >{home}/opened.part && mv {home}/opened.part {home}/opened\n')
    browser.chmod(0o755)
    kept = {name: text for name, text in os.environ.items() if re.match(r"(?i)pip_|https?_proxy|no_proxy|ssl_cert", name)}
    env = {
        **kept,
        "HOME": str(home),
        "PATH": f"{programs}:/usr/bin:/bin",
        "LANG": "C.UTF-8",
        "TERM": "dumb",
        "PS1": r"[done $?] ",
        "XDG_RUNTIME_DIR": str(home / "r"),
    }
    return folder, env


def address(home: Path) -> Address:
    """What the user's browser was told to open."""
    opened_file = home / "opened"
    text = opened_file.read_text()
    opened_file.unlink()
    return Address(text)


def main(wheel: Path, home: Path) -> None:
    take = Commands().take
    folder, env = desk(home, wheel)
    daemon = Terminal(folder, env)
    print(machine())
    clock = Watch()
    daemon.run(take("python3 -m venv"))
    clock.step("an environment of Python")
    daemon.run(take("venv/bin/pip install"))
    daemon.run(take("export PATH"))
    program = daemon.run("command -v depthrig").splitlines()[1]
    assert program == str(folder / "venv/bin/depthrig"), program
    daemon.run(take("depthrig --version"))
    clock.step("pip install")

    (folder / "first.toml").write_text(blocks(TUTORIAL, "toml")[0])
    daemon.run(take("depthrig config check"))
    daemon.start(take("depthrig run"))
    user = Terminal(folder, env)
    user.run(take("export PATH"))
    status = take("depthrig status")
    while "streaming" not in user.run(status, (0, 1, 3)):
        assert daemon.shell.poll() is None, daemon.shown
    clock.step("the rig streams")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        user.run(take("depthrig open"))
        with opened(browser, address(home)) as wall:
            wall.wait_for_image(*STREAMS)
            assert sorted(wall.streams()) == sorted(STREAMS)
            clock.step("the page shows all cameras")
            wall.page.wait_for_function(RENDERED, timeout=LIMIT_S * 1000, polling=100)
            clock.step("the simulated scenes are rendered")
            record(wall, 10)
            clock.step("recorded with Space, 10 s")
            watch(wall, *STREAMS)
            clock.step("the recording is watched")
            total = clock.last - clock.begin
            leave(wall)
        print(f"{total:7.1f} s  from `pip install` to watching the recording; {machine()}")
        assert SCENE in user.run(take("depthrig sessions"))
        user.run(take("depthrig verify"), (0, 3))
        daemon.interrupt()
        daemon.start(take("depthrig replay"))
        again = take("depthrig open")
        while "\nopened " not in user.run(again, (0, 1)):
            assert daemon.shell.poll() is None, daemon.shown
        with opened(browser, address(home)) as wall:
            wall.page.wait_for_selector("#replay:not([hidden])")
            wall.wait_for_image(*STREAMS)
        browser.close()
        clock.step("verified; replayed on the cameras' channels")
    daemon.interrupt()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
