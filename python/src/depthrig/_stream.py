"""Subscribing to one stream of one camera."""

from __future__ import annotations

import ctypes
import os

from ._bus import FRAME_HEADER, Bus
from ._frame import Frame
from ._header import Header
from ._layout import HEADER_SIZE
from ._reader import Reader
from ._runtime import PathLike, check_name, not_running, pick_rig, runtime_dir


class Stream(Reader[Frame]):
    """A stream of a rig: `Stream("d435/depth")`.

    Up to four unread frames wait for the reader; older ones are replaced by newer ones and counted in
    :attr:`missed`. Up to 16 frames (or arrays of them) may be held at once.

    `rig` is the rig's name, by default the only one that runs. `runtime_dir` is its runtime folder, by default that of
    this user. `timeout` is how many seconds to wait for the rig and the stream to appear.

    Iterating yields each frame as it comes and raises StreamGone when nobody publishes any more.
    """

    def __init__(
        self,
        stream: str,
        rig: str | None = None,
        runtime_dir: PathLike | None = None,
        timeout: float = 2.0,
    ) -> None:
        camera, slash, name = stream.partition("/")
        if not slash:
            raise ValueError(f"{stream!r} is no stream: write CAMERA/STREAM, such as d435/depth")
        check_name(camera, "camera")
        check_name(name, "stream")
        self.name = stream
        self._last_sequence = 0
        self._missed = 0
        super().__init__(stream, FRAME_HEADER, rig, runtime_dir, timeout)

    @property
    def missed(self) -> int:
        """Frames that were published but replaced before this subscriber read them."""
        return self._missed

    def _take(self) -> Frame | None:
        receiver = self._open
        sample = receiver.receive()
        if sample is None:
            return None
        header = Header(ctypes.string_at(sample.user_header_ptr, HEADER_SIZE))
        header.check_version(receiver.what)
        sequence = header.sequence
        # The first frame sets the mark; a smaller number means that the publisher was restarted.
        if 0 < self._last_sequence < sequence:
            self._missed += sequence - self._last_sequence - 1
        self._last_sequence = sequence
        return Frame(sample, header, sample.payload_ptr, sample.header.number_of_elements)

    def __repr__(self) -> str:
        state = "closed" if self._receiver is None else f"at #{self._last_sequence}, {self._missed} missed"
        return f"<Stream {self.name} of rig {self.rig!r}, {state}>"


def streams(rig: str | None = None, runtime_dir: PathLike | None = None) -> list[str]:
    """List the streams of a rig (by default the only one that runs) that can be subscribed to now."""
    folder = _runtime_dir(runtime_dir)
    name = pick_rig(folder, rig)
    if not os.path.isdir(folder):
        raise not_running(folder, name)
    return Bus.at(folder).streams(name)


_runtime_dir = runtime_dir
