"""Subscribing to one stream of one camera."""

from __future__ import annotations

import ctypes
import os
import time
from typing import TYPE_CHECKING

from . import _layout
from ._bus import FRAME_HEADER, Bus
from ._frame import Frame
from ._header import VERSION_BYTES, Header, HeaderBytes, essentials
from ._layout import PixelFormat
from ._reader import SLICE_S, Reader
from ._period import FramePeriod
from ._runtime import PathLike, check_name, not_running, pick_rig, runtime_dir
from .errors import Stale

if TYPE_CHECKING:
    import torch

# Shorter rests are not worth it.
_SHORTEST_REST_NS = 3_000_000


class Stream(Reader[Frame]):
    """A stream of a rig: `Stream("d435/depth")`.

    Up to four unread frames wait for the reader; older ones are replaced by newer ones and counted in
    :attr:`missed`. Up to 16 frames (or arrays of them) may be held at once.

    `rig` is the rig's name, by default the only one that runs. `runtime_dir` is its runtime folder, by default that of
    this user. `timeout` is how many seconds to wait for the rig and the stream to appear.

    `prepare`: a reader that waits for a steady stream wakes half a millisecond before the next frame is due, so that it
    has its code in the caches when the frame comes, and reads it in half the time. It costs some CPU for each frame.

    Iterating yields each frame as it comes and raises StreamGone when the publisher has gone.
    """

    def __init__(
        self,
        stream: str,
        rig: str | None = None,
        runtime_dir: PathLike | None = None,
        timeout: float = 2.0,
        *,
        prepare: bool = True,
    ) -> None:
        camera, slash, name = stream.partition("/")
        if not slash:
            raise ValueError(f"invalid stream name {stream!r}: write CAMERA/STREAM, such as d435/depth")
        check_name(camera, "camera")
        check_name(name, "stream")
        self.name = stream
        self._last_sequence = 0
        self._missed = 0
        self._restarts = 0
        self._period = FramePeriod() if prepare else None
        self._newest_ns: int | None = None
        self.header: Header | None = None
        """Header of the frame that :meth:`torch` returned last."""
        super().__init__(stream, FRAME_HEADER, rig, runtime_dir, timeout)

    @property
    def missed(self) -> int:
        """Frames that were published but replaced before this subscriber read them."""
        return self._missed

    @property
    def restarts(self) -> int:
        """How often the numbering began anew: the daemon, the camera or its stage was restarted."""
        return self._restarts

    def wait_fresh(self, max_age: float, timeout: float | None = None) -> Frame:
        """Return the newest unread frame whose exposure is at most `max_age` seconds ago, waiting for one if need be.

        Waits up to `timeout` seconds, by default `max_age`: a policy that asks for each frame so never acts on older
        depth. Raises Stale, with the age of the newest frame, when no fresh one came; StreamGone instead when the
        publisher has gone. The age counts from the middle of the exposure, so that of refined depth
        contains the time that refining took. A frame is returned once: between two of them, look at the `age_s` of
        the one you have. Frames of a replay carry the times of their recording, have no age, and raise Stale at once.
        """
        if not max_age > 0:
            raise ValueError(f"max_age is a number of seconds above 0, not {max_age!r}")
        now = time.monotonic()
        deadline = now + (max_age if timeout is None else timeout)
        while True:
            frame = self.latest()
            if frame is not None:
                if frame.replayed:
                    raise Stale(
                        f"{self._open.what}: it is replayed, its frames carry the times of the recording and have no "
                        "age; read a replay with next() or latest()",
                        None,
                        max_age,
                    )
                if frame.age_s <= max_age:
                    return frame
                frame = None  # gives its slot back
            now = time.monotonic()
            if now >= deadline:
                self._check_publisher()
                raise self._stale(max_age)
            self._pause(min(SLICE_S, deadline - now))

    def _stale(self, max_age: float) -> Stale:
        if self._newest_ns is None:
            return Stale(f"{self._open.what}: no frame has come yet, and one of {max_age:g} s is needed", None, max_age)
        age = (time.monotonic_ns() - self._newest_ns) / 1e9
        return Stale(
            f"{self._open.what}: its newest frame is {age:.3f} s old, at most {max_age:g} s is allowed; "
            "`depthrig status` shows what the camera and its stage are doing",
            age,
            max_age,
        )

    def torch(
        self,
        device: str | torch.device = "cpu",
        *,
        max_age: float | None = None,
        timeout: float | None = None,
        metres: bool = False,
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the newest unread frame's pixels as a tensor on `device`; its header is in :attr:`header`.

        Waits for a frame up to `timeout` seconds (None: as long as it takes) and raises Timeout and StreamGone as
        :meth:`next` does; with `max_age` it is :meth:`wait_fresh` that waits. One copy to the device, after which the
        frame's slot is free again; `metres` and `out` as for :meth:`Frame.torch`, which also has `copy`.
        """
        if max_age is not None:
            frame = self.wait_fresh(max_age, timeout)
        else:
            newest = self.latest()
            frame = self.next(timeout) if newest is None else newest
        tensor = frame.torch(device, metres=metres, out=out)
        self.header = frame.header
        return tensor

    def _take(self) -> Frame | None:
        receiver = self._receiver or self._open
        sample = receiver.receive()
        if sample is None:
            return None
        raw = HeaderBytes.from_address(sample.user_header_ptr)
        fields = essentials(raw)
        if fields[0] != VERSION_BYTES:
            Header(bytes(raw)).check_version(receiver.what)
        sequence, last = fields[1], self._last_sequence
        if sequence != last + 1 and last > 0:  # the first frame sets the reference
            if sequence > last:
                self._missed += sequence - last - 1
            else:  # a smaller number means that the publisher was restarted
                self._restarts += 1
        self._last_sequence = sequence
        self._newest_ns = fields[2]
        if self._period is not None:
            self._period.observe(sequence, fields[3])
        return Frame(sample, raw, fields, sample.payload_ptr, sample.header.number_of_elements)

    def _pause(self, seconds: float) -> None:
        if self._period is not None:
            rest_ns = self._period.rest_ns(time.monotonic_ns())
            if _SHORTEST_REST_NS < rest_ns < seconds * 1e9:
                if self._open.rest(rest_ns):
                    _walk()
                return
        self._open.wait(seconds)

    def __repr__(self) -> str:
        state = "closed" if self._receiver is None else f"at #{self._last_sequence}, {self._missed} missed"
        return f"<Stream {self.name} of rig {self.rig!r}, {state}>"


# A frame of one pixel in our own memory, for warming up the code path.
_PIXEL = ctypes.create_string_buffer(2)
_HEADER = HeaderBytes.from_buffer_copy(
    Header.pack(
        {name: b"" if kind == "u8" else [0] * count for name, _, kind, count in _layout.FIELDS}
        | {"magic": _layout.HEADER_MAGIC, "version": _layout.HEADER_VERSION, "size": _layout.HEADER_SIZE}
        | {"format": int(PixelFormat.Z16), "width": 1, "height": 1, "stride": 2, "payload_len": 2}
    )
)


def _walk() -> None:
    """Create an array as :meth:`Stream._take` does, to warm the caches."""
    raw = HeaderBytes.from_address(ctypes.addressof(_HEADER))
    fields = essentials(raw)
    if fields[0] == VERSION_BYTES:
        _ = Frame(_PIXEL, raw, fields, ctypes.addressof(_PIXEL), 2).array


def streams(rig: str | None = None, runtime_dir: PathLike | None = None) -> list[str]:
    """List the streams of a rig (by default the only one that runs) that can be subscribed to now."""
    folder = _runtime_dir(runtime_dir)
    name = pick_rig(folder, rig)
    if not os.path.isdir(folder):
        raise not_running(folder, name)
    return Bus.at(folder).streams(name)


_runtime_dir = runtime_dir
