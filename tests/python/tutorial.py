"""docs/tutorial.md for those who follow it: its examples, and what it does on the page."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

from page import Wall
from test_daemon import ROOT

TUTORIAL = ROOT / "docs" / "tutorial.md"
SCENE = "kitchen"
FENCE = re.compile(r"^( *)```(\w+)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)


def blocks(path: Path, language: str) -> list[str]:
    """Examples of a document in one language."""
    found = FENCE.findall(path.read_text())
    return [re.sub(f"(?m)^{indent}", "", text) for indent, name, text in found if name == language]


def shell(path: Path) -> list[str]:
    """Commands of a document's examples, without comments."""
    return [line for text in blocks(path, "sh") for line in (re.sub(r"\s+#.*", "", raw) for raw in text.splitlines()) if line]


class Commands:
    """The commands of the tutorial that nobody has followed yet."""

    def __init__(self) -> None:
        self.left = shell(TUTORIAL)

    def take(self, start: str) -> str:
        """The first command that begins so, which is crossed off."""
        found = next((line for line in self.left if line.startswith(start)), None)
        assert found is not None, f"{TUTORIAL.name} has no further command {start}"
        self.left.remove(found)
        return found


def record(wall: Wall, seconds: float, during: Callable[[], None] = lambda: None) -> None:
    """Names the scene, starts a recording with Space and stops it so."""
    wall.page.fill("#scene", SCENE)
    wall.page.keyboard.press("Escape")
    wall.press_record("recording")
    time.sleep(seconds)
    during()
    wall.press_record("idle")


def watch(wall: Wall, *streams: str) -> None:
    """Opens the newest recording, which takes the place of the cameras."""
    wall.page.keyboard.press("l")
    wall.page.get_by_role("button", name="Watch").first.click()
    wall.page.wait_for_selector("#replay:not([hidden])")
    wall.wait_for_image(*streams)


def leave(wall: Wall) -> None:
    """Gives the wall back to the cameras."""
    wall.page.keyboard.press("Escape")
    wall.page.keyboard.press("Escape")
    wall.page.wait_for_selector("#replay", state="hidden")
