"""`depthrig top` in a real pseudo-terminal. Its images are read by programs that are not ours: pyte, libsixel, Pillow."""

from __future__ import annotations

import re
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from page import FAR, HOLE, MIDDLE, NEAR, PATCHES, SIMULATED, Patch, files_camera, pattern, until
from PIL import Image
from terminal import ATTRIBUTES_QUESTION, KITTY, KITTY_QUESTION, PLAIN, SIXEL, Terminal, terminal
from test_daemon import WAIT_S, binary, command, running, runtime

__all__ = ["binary", "runtime"]

ERROR = 12
"""Most that a colour of an even patch changes as a JPEG of a preview."""
SIXEL_ERROR = 24
"""The same with a palette of 128 colours, whose levels are percent."""
HOLE_COLOR = (0x26, 0x28, 0x2C)
IMAGE = re.compile("▀".encode() + rb"|\x1bP0;1;0q|\x1b_Ga=T")


@pytest.fixture(scope="module", autouse=True)
def rig(binary: str, runtime: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("top")
    manifest = pattern(folder / "pattern")
    text = '[recording]\ndirectory = "datasets"\nreserve_mb = 64\n' + files_camera("still", manifest) + SIMULATED.format(name="moving")
    file = folder / "rig.toml"
    file.write_text(f'rig = "top"\n{text}')
    with running(binary, runtime, folder / "log", "run", str(file)):
        deadline = time.monotonic() + WAIT_S
        while "still/depth" not in command(binary, runtime, "status", codes=(0, 1, 3)):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        yield


def at(image: Image.Image, patch: Patch) -> tuple[int, int, int]:
    return image.getpixel((int(patch.x * image.width), int(patch.y * image.height)))


def check(color: Image.Image, depth: Image.Image, error: int) -> None:
    """The pattern's colours, and its depth: near red, far blue, between them green, holes grey."""
    for patch in PATCHES:
        shown = at(color, patch)
        assert max(abs(a - b) for a, b in zip(shown, patch.color)) <= error, f"{shown} where the camera sees {patch.color}"
    # The range is that of all streams, so only the order of colours is known.
    near, middle, far, hole = (at(depth, patch) for patch in (NEAR, MIDDLE, FAR, HOLE))
    assert near[0] - near[2] > middle[0] - middle[2] > far[0] - far[2], (near, middle, far)
    assert near[0] > near[2] + 60 and far[2] > far[0] + 60, (near, far)
    assert max(abs(a - b) for a, b in zip(hole, HOLE_COLOR)) <= (error if error > ERROR else 0), hole


@contextmanager
def terminal_with_images(binary: str, runtime: Path, answer: bytes, how: str) -> Iterator[Terminal]:
    """A terminal that shows images as its answer says; `top` shows blocks when a busy computer answers too late."""
    for others in (2, 1, 0):
        with terminal(binary, runtime, "--images", answer=answer) as shown:
            said = until(lambda: re.search(r"images as (\w+)", "\n".join(shown.screen().display)))[1]
            if said != "blocks" or others == 0:
                assert said == how
                yield shown
                return


def test_half_blocks_show_the_cameras_colours(binary: str, runtime: Path) -> None:
    with terminal(binary, runtime, "--images=blocks") as shown:
        shown.wait_for("still/depth", "streaming", "images as blocks", "▀")

        def check_blocks() -> bool:
            check(shown.block_image("still/color"), shown.block_image("still/depth"), ERROR)
            assert shown.block_image("moving/color").width > 20
            return True

        def is_right() -> bool:
            with suppress(AssertionError):
                return check_blocks()
            return False

        # An image may not be there yet, or in part.
        until(is_right, check_blocks)
        shown.type(b"q")
        assert shown.ends() == 0


@pytest.mark.skipif(shutil.which("sixel2png") is None, reason="no sixel2png; tools/setup.sh test installs it")
def test_sixel_images_show_the_cameras_colours(binary: str, runtime: Path, tmp_path: Path) -> None:
    with terminal_with_images(binary, runtime, SIXEL, "sixel") as shown:
        until(lambda: shown.written.count(b"\x1bP0;1;0q") >= 8)
        places = {stream: shown.label(stream) for stream in ("still/color", "still/depth")}
        shown.type(b"q")
        assert shown.ends() == 0
        images = {(image.row - 2, image.column - 1): image.image for image in shown.sixel_images(tmp_path)}
        check(images[places["still/color"]], images[places["still/depth"]], SIXEL_ERROR)
        # No more than that together.
        assert sum(image.width * image.height for image in images.values()) <= 500_000


def test_kitty_images_show_the_cameras_colours(binary: str, runtime: Path) -> None:
    with terminal_with_images(binary, runtime, KITTY, "kitty") as shown:
        until(lambda: shown.written.count(b"\x1b_Ga=T") >= 8)
        places = {stream: shown.label(stream) for stream in ("still/color", "still/depth")}
        shown.type(b"q")
        assert shown.ends() == 0
        images = {(image.row - 2, image.column - 1): image.image for image in shown.kitty_images()}
        check(images[places["still/color"]], images[places["still/depth"]], ERROR)


def test_without_an_answer_and_in_a_multiplexer_images_are_blocks(binary: str, runtime: Path) -> None:
    for answer, env in ((PLAIN, {}), (b"", {}), (KITTY, {"TMUX": "/tmp/tmux-0/default,1,0"}), (SIXEL, {"TERM": "screen-256color"})):
        with terminal(binary, runtime, "--images", answer=answer, env=env) as shown:
            shown.wait_for("images as blocks", "▀")
            assert (ATTRIBUTES_QUESTION in shown.written) == (not env)
            assert (KITTY_QUESTION in shown.written) == (not env)
            shown.type(b"q")
            assert shown.ends() == 0


def test_a_key_shows_and_hides_images(binary: str, runtime: Path) -> None:
    with terminal(binary, runtime) as shown:
        shown.wait_for("still/depth", "streaming", "i shows images")
        assert not IMAGE.search(shown.written) and ATTRIBUTES_QUESTION not in shown.written
        shown.type(b"i")
        shown.wait_for("i hides images", "▀")
        # Arrows and late answers of the terminal are no keys, though there are letters in them.
        shown.type(b"\x1b[A\x1b_Gi=31;OK\x1b\\\x1b[?62;4;22c\x1b]0;quit\x07")
        time.sleep(1)
        shown.wait_for("i hides images", "▀")
        shown.type(b"i")
        shown.wait_for("i shows images", "still/depth", "streaming")
        before = len(shown.written)
        time.sleep(2)
        assert not IMAGE.search(shown.written[before:])
        assert "▀" not in "".join(shown.screen().display)
        shown.type(b"Q")
        assert shown.ends() == 0


@pytest.mark.parametrize("how", ["blocks", "sixel", "kitty"])
def test_images_take_no_more_than_they_may(binary: str, runtime: Path, how: str) -> None:
    with terminal(binary, runtime, f"--images={how}", rows=200, columns=400) as shown:
        shown.wait_for(f"images as {how}")
        time.sleep(1)
        before, began = len(shown.written), time.monotonic()
        time.sleep(5)
        rate = (len(shown.written) - before) / (time.monotonic() - began)
        print(how, round(rate / 1000), "kB/s")
        # A round more than the time has room for.
        assert 10_000 < rate < 1_300_000
        shown.type(b"q")
        assert shown.ends() == 0


@pytest.mark.parametrize("how", ["off", "blocks", "kitty"])
def test_the_terminal_is_given_back(binary: str, runtime: Path, how: str) -> None:
    for end in (lambda t: t.type(b"\x03"), lambda t: t.process.send_signal(signal.SIGTERM)):
        with terminal(binary, runtime, f"--images={how}") as shown:
            shown.wait_for("still/depth", "streaming")
            end(shown)
            assert shown.ends() == 0


def test_screens_of_any_size_are_taken(binary: str, runtime: Path) -> None:
    with terminal(binary, runtime, "--images=blocks", rows=3, columns=10) as shown:
        for rows, columns in ((3, 10), (1, 1), (60, 12), (8, 200), (50, 120)):
            shown.resize(rows, columns)
            time.sleep(1.5)
            assert shown.process.poll() is None
        shown.wait_for("images as blocks", "▀")
        shown.type(b"q")
        assert shown.ends() == 0


def test_the_end_of_the_rig_is_an_error_on_a_terminal_given_back(binary: str, runtime: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('rig = "short"\n' + SIMULATED.format(name="front"))
    with running(binary, runtime, tmp_path / "log", "run", str(rig)):
        deadline = time.monotonic() + WAIT_S
        while "front/color" not in command(binary, runtime, "status", "--rig", "short", codes=(0, 1, 3)):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        shown = terminal(binary, runtime, "--images=blocks", "--rig", "short")
        opened: Terminal = shown.__enter__()
        opened.wait_for("▀")
    try:
        assert opened.ends() == 1
        after = opened.written[opened.written.rindex(b"\x1b[?1049l") :]
        assert b"depthrig: error:" in after
    finally:
        shown.__exit__(None, None, None)
