"""A terminal for `depthrig top` and `collect`: a real pseudo-terminal whose other end answers as terminals of some kind do."""

from __future__ import annotations

import base64
import fcntl
import io
import os
import pty
import re
import select
import signal
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pyte
from PIL import Image
from test_daemon import WAIT_S, environment

CELL = (10, 20)
KITTY_QUESTION = b"\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\"
ATTRIBUTES_QUESTION = b"\x1b[c"
KITTY = b"\x1b_Gi=31;OK\x1b\\\x1b[6;20;10t\x1b[?62;c"
SIXEL = b"\x1b[6;20;10t\x1b[?62;4;22c"
PLAIN = b"\x1b[?1;2c"
LEAVE = b"\x1b[?25h\x1b[?1049l"
SIXEL_IMAGE = re.compile(rb"\x1b\[(\d+);(\d+)H(\x1bP0;1;0q[^\x1b]*\x1b\\)")
KITTY_IMAGE = re.compile(rb"\x1b\[(\d+);(\d+)H((?:\x1b_G[^\x1b]*m=1;[^\x1b]*\x1b\\)*\x1b_G[^\x1b]*m=0;[^\x1b]*\x1b\\)")


@dataclass
class Shown:
    """An image on the screen, and where its upper left corner is."""

    row: int
    column: int
    image: Image.Image


class Terminal:
    """A terminal with a command in it."""

    def __init__(self, command: list[str], env: dict[str, str], rows: int, columns: int, answer: bytes) -> None:
        self.answer = answer
        self.master, slave = pty.openpty()
        self.resize(rows, columns)
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        self.output = b""
        self.lock = threading.Lock()
        self.process = subprocess.Popen(
            command, env=env, stdin=slave, stdout=slave, stderr=slave, start_new_session=True, preexec_fn=take_terminal
        )
        self.is_open = True
        self.reader = threading.Thread(target=self._read)
        self.reader.start()

    def resize(self, rows: int, columns: int) -> None:
        self.rows = rows
        self.columns = columns
        self.fed = 0
        self.emulated = pyte.Screen(columns, rows)
        self.stream = pyte.ByteStream(self.emulated)
        size = struct.pack("HHHH", rows, columns, 0, 0)
        fcntl.ioctl(self.master, termios.TIOCSWINSZ, size)

    def _read(self) -> None:
        asked = 0
        while self.is_open:
            ready, _, _ = select.select([self.master], [], [], 0.05)
            if not ready:
                continue
            try:
                data = os.read(self.master, 1 << 16)
            except OSError:
                return
            with self.lock:
                self.output += data
                questions = self.output.count(ATTRIBUTES_QUESTION)
            if questions > asked and self.answer:
                os.write(self.master, self.answer)
            asked = questions

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    @property
    def written(self) -> bytes:
        with self.lock:
            return self.output

    def screen(self) -> pyte.Screen:
        """What a terminal emulator makes of the output."""
        written = self.written
        # The emulator does not know strings of applications (APC) and devices (DCS): images and questions. The last may
        # have come in part.
        new = re.sub(rb"\x1b[_P][^\x1b]*\x1b\\", b"", written[self.fed :])
        rest = re.search(rb"\x1b(?:[_P][^\x1b]*\x1b?)?$", new)
        text = new[: rest.start()] if rest else new
        self.fed = len(written) - (len(rest[0]) if rest else 0)
        self.stream.feed(text.replace(b"\x1b[16t", b""))
        return self.emulated

    def wait_for(self, *texts: str) -> None:
        deadline = time.monotonic() + WAIT_S
        while True:
            shown = "\n".join(self.screen().display)
            if all(text in shown for text in texts):
                return
            assert time.monotonic() < deadline and self.process.poll() is None, f"no {texts} in\n{shown}"
            time.sleep(0.1)

    def ends(self) -> int:
        """Waits for the end of the command; the terminal must then be as it was."""
        code = self.process.wait(WAIT_S)
        deadline = time.monotonic() + WAIT_S
        while LEAVE not in self.written:
            assert time.monotonic() < deadline, self.written[-200:]
            time.sleep(0.02)
        time.sleep(0.1)
        assert self.written.rindex(LEAVE) > self.written.rindex(b"\x1b[?1049h")
        assert termios.tcgetattr(self.slave) == self.before, "the keyboard is not as it was"
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait()
        self.is_open = False
        self.reader.join()
        os.close(self.master)
        os.close(self.slave)

    def label(self, stream: str) -> tuple[int, int]:
        """Row and column, from 0, of the line above a stream's image: the name alone, below the table."""
        rows = self.screen().display
        found = [(i, m.start()) for i, row in enumerate(rows) for m in re.finditer(rf"(?<!\S){re.escape(stream)}(?!\S)", row)]
        assert found, f"no {stream} in\n" + "\n".join(rows)
        return found[-1]

    def block_image(self, stream: str) -> Image.Image:
        """The image of half blocks below a stream's label."""
        screen = self.screen()
        row, column = self.label(stream)
        lines = []
        for y in range(row + 1, self.rows):
            width = 0
            while column + width < self.columns and screen.buffer[y][column + width].data == "▀":
                width += 1
            if width == 0:
                break
            cells = [screen.buffer[y][column + x] for x in range(width)]
            lines += [[rgb(cell.fg) for cell in cells], [rgb(cell.bg) for cell in cells]]
        assert lines, f"no image below {stream}"
        image = Image.new("RGB", (len(lines[0]), len(lines)))
        image.putdata([pixel for line in lines for pixel in line])
        return image

    def sixel_images(self, folder: Path) -> list[Shown]:
        """Sixel images, decoded by libsixel."""
        found = []
        for i, (row, column, data) in enumerate(SIXEL_IMAGE.findall(self.written)):
            source, target = folder / f"{i}.six", folder / f"{i}.png"
            source.write_bytes(data)
            subprocess.run(["sixel2png", "-i", source, "-o", target], check=True, timeout=WAIT_S, capture_output=True)
            found.append(Shown(int(row), int(column), Image.open(target).convert("RGB")))
        return found

    def kitty_images(self) -> list[Shown]:
        """Images of kitty's protocol: PNG in parts."""
        found = []
        for row, column, data in KITTY_IMAGE.findall(self.written):
            payload = b"".join(re.findall(rb"\x1b_G[^;]*;([^\x1b]*)\x1b\\", data))
            found.append(Shown(int(row), int(column), Image.open(io.BytesIO(base64.b64decode(payload)))))
        return found


def rgb(color: str) -> tuple[int, int, int]:
    if color == "default":
        return (0, 0, 0)
    return (int(color[0:2], 16), int(color[2:4], 16), int(color[4:6], 16))


def take_terminal() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


@contextmanager
def terminal(
    binary: str,
    runtime: Path,
    *options: str,
    rows: int = 50,
    columns: int = 120,
    answer: bytes = PLAIN,
    env: dict[str, str] | None = None,
    command: str = "top",
) -> Iterator[Terminal]:
    outside = {name: value for name, value in environment(runtime).items() if name not in ("TMUX", "NO_COLOR")}
    where = {**outside, "TERM": "xterm-256color", **(env or {})}
    opened = Terminal([binary, command, *options], where, rows, columns, answer)
    try:
        yield opened
    finally:
        opened.close()
