"""One start of an external camera: its streams, and frames on their way to the daemon."""

from __future__ import annotations

import ctypes
import struct
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import _layout as layout
from ._bus import Bus
from ._external_answer import Answer
from ._external_mode import ExternalMode
from ._frame import _Owner
from ._layout import ExternalClock, ExternalFrameFlags, ExternalReason, ExternalState, ExternalWant, PixelFormat
from ._ports import FRAME, FRAMES, Sender, Slot

if TYPE_CHECKING:
    from ._external import ExternalCamera

# How often to check for a slot that the daemon has given back.
_SLOT_PAUSE_S = 0.002
_FRAME_HEAD = struct.Struct("<4sHHQQQQQqQff5II32x")
assert _FRAME_HEAD.size == layout.EXTERNAL_FRAME_SIZE


class ExternalSession:
    """One start of the camera: frames of `streams` are wanted until :attr:`wanted` is false.

    Returned by :meth:`ExternalCamera.wait`; ends with :meth:`close` or its `with` block.
    """

    def __init__(self, camera: ExternalCamera, answer: Answer) -> None:
        self._camera = camera
        self.number = answer.session
        """Number of the session; each is higher than the one before."""
        self.streams: dict[str, ExternalMode] = {
            mode.stream: mode for mode, wanted in zip(camera.modes, answer.modes) if wanted
        }
        """The modes that are to run, by stream."""
        self._channels: dict[str, _Channel] = {}
        self._running = False
        self._lossless = False
        self._over = False

    @property
    def wanted(self) -> bool:
        """Whether the daemon is there and still wants frames of this session."""
        camera = self._camera
        answer = camera._answer
        return (
            not (self._over or camera._stopped or camera._closed)
            and camera._failure is None
            and answer is not None
            and answer.fresh
            and answer.want is ExternalWant.RUN
            and answer.session == self.number
        )

    def start(self, *, lossless: bool = False) -> None:
        """Report that the camera runs, and create the channels; the first :meth:`send` does it as well.

        A live camera cannot wait: newer frames replace a frame that nobody has read. With `lossless`, for files,
        :meth:`send` and :meth:`lend` wait until the daemon has read earlier ones, and none is replaced.
        """
        self._camera._check()
        if self._over:
            raise ValueError("this session is over")
        if not self._running:
            bus, prefix = self._camera._bus, self._camera._prefix
            # With no more slots than may wait unread, there is no slot for the frame that would replace one.
            slots = layout.EXTERNAL_BUFFER if lossless else layout.EXTERNAL_FRAME_SLOTS
            for stream, mode in self.streams.items():
                self._channels[stream] = _Channel(bus, f"{prefix}/frames/{stream}", mode, slots)
            self._lossless = lossless
            self._running = True
            self._camera._set_state(ExternalState.RUNNING)

    def send(self, stream: str, pixels: Any, **facts: Any) -> bool:
        """Copy a frame into shared memory and send it; return false when it was not sent, which the daemon counts.

        `pixels` is an array of the mode's shape and type (as :attr:`Frame.array` has it; rows may be padded), or its
        bytes. The facts are:

        * `device_time`: mid-exposure in ticks of the clock that the mode names; None when unknown.
        * `device_sequence`: the device's own frame counter.
        * `arrival_ns`: when the frame had come, on the clock of :func:`time.monotonic_ns`; now by default.
        * `exposure_ns`, `gain`, `temperature_c`: as far as they are known.
        * `damaged`, `triggered`: whether the device flagged it as damaged, or a hardware trigger started it.

        Raises ValueError when the pixels do not fit the mode.
        """
        channel = self._channel(stream)
        source = channel.fit(pixels)
        lent = self._lend(channel, source.size if channel.mode.format is PixelFormat.MJPEG else channel.length)
        if lent is None:
            return False
        np.copyto(lent.array, source)
        return lent.send(**facts)

    def lend(self, stream: str, length: int | None = None) -> Lent | None:
        """Lend a slot to write pixels into where the daemon reads them; None when there is no free one.

        Its `array` has the mode's shape; with MJPEG, `length` bytes. `lent.send(…)` takes the facts of :meth:`send`;
        the array must not be written to afterwards. A slot that is forgotten is given back, and the frame counted.
        """
        channel = self._channel(stream)
        return self._lend(channel, channel.length if length is None else length)

    def skip(self, stream: str, frames: int = 1) -> None:
        """Count frames of the camera that are not sent, such as those of a full queue."""
        self._channel(stream).sequence += frames

    def _channel(self, stream: str) -> _Channel:
        if not self._running or self._over:
            self.start()
        channel = self._channels.get(stream)
        if channel is None:
            raise ValueError(f"stream {stream!r} is not to run; to run are: {', '.join(self._channels) or 'none'}")
        return channel

    def _lend(self, channel: _Channel, length: int) -> Lent | None:
        slot = channel.sender.loan(length)
        while slot is None and self._lossless:
            if not self.wanted:
                return None  # it was not sent, and is not lost: the next session may have it
            time.sleep(_SLOT_PAUSE_S)
            slot = channel.sender.loan(length)
        channel.sequence += 1
        if slot is None:
            channel.no_slot += 1
            return None
        return Lent(self, channel, slot, length)

    def refuse(self, text: str, reason: ExternalReason = ExternalReason.UNSUPPORTED) -> None:
        """Report that the session cannot run, and end it; `text` is shown to the user.

        After UNSUPPORTED and INVALID the camera is `failed`, after other reasons it is tried again.
        """
        self._finish(ExternalState.REFUSED, reason, text)

    def finish(self, text: str, timeout: float = 10.0) -> bool:
        """Report that there are no more frames, and wait until the daemon has taken those that were sent.

        For files at their end; `text` is shown to the user. Returns whether the daemon confirmed within `timeout`
        seconds that it has them all. The session is over then; close the camera with `ExternalReason.FINISHED`.
        """
        if self._over:
            return False
        self._over = True
        camera = self._camera
        camera._set_state(ExternalState.REFUSED, ExternalReason.FINISHED, text)
        # The channels stay until then, for a daemon that has not read them yet.
        taken = camera._wait_for_stop(self.number, timeout)
        camera._current = None
        self._channels.clear()
        return taken

    def close(self) -> None:
        """Report that the camera has stopped."""
        self._finish(ExternalState.IDLE, ExternalReason.NONE, "")

    def _finish(self, state: ExternalState, reason: ExternalReason, text: str) -> None:
        if self._over:
            return
        self._over = True
        self._camera._current = None
        self._camera._set_state(state, reason, text)
        self._channels.clear()

    @property
    def no_slot(self) -> dict[str, int]:
        """Frames that were not sent because the daemon had not read those before, by stream."""
        return {stream: channel.no_slot for stream, channel in self._channels.items()}

    def __enter__(self) -> ExternalSession:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, _: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        modes = ", ".join(map(str, self.streams.values()))
        return f"<ExternalSession {self.number} of camera {self._camera.name!r}: {modes}>"


class _Channel:
    """A stream of a session: where its frames go, and how many there were."""

    def __init__(self, bus: Bus, name: str, mode: ExternalMode, slots: int) -> None:
        self.mode = mode
        self.length = mode.frame_bytes
        self.shape, self.dtype = mode.shape, mode.dtype
        self.sender = Sender(bus, name, FRAME, self.length, slots, FRAMES)
        self.sequence = 0
        self.no_slot = 0

    def fit(self, pixels: Any) -> npt.NDArray[Any]:
        """Return `pixels` as an array of the mode's shape and type, without a copy; else ValueError."""
        array = pixels if isinstance(pixels, np.ndarray) else np.frombuffer(pixels, np.uint8)
        if self.mode.format is PixelFormat.MJPEG:
            if array.dtype != np.uint8 or array.ndim != 1 or not 0 < array.size <= self.length:
                raise ValueError(
                    f"a JPEG of stream {self.mode.stream!r} is 1 to {self.length} bytes, not {array.shape} "
                    f"{array.dtype}"
                )
            return array
        if array.shape == self.shape and array.dtype == self.dtype:
            return array
        if array.ndim == 1 and array.dtype == np.uint8 and array.size == self.length and array.flags.c_contiguous:
            return array.view(self.dtype).reshape(self.shape)
        raise ValueError(
            f"a frame of stream {self.mode.stream!r} ({self.mode}) is {self.shape} {self.dtype}, not "
            f"{array.shape} {array.dtype}"
        )


class Lent:
    """A slot of shared memory to write a frame into."""

    __slots__ = ("_channel", "_session", "_slot", "array")

    array: npt.NDArray[Any]
    """The pixels, to be written to until :meth:`send`; their initial content is arbitrary."""

    def __init__(self, session: ExternalSession, channel: _Channel, slot: Slot, length: int) -> None:
        self._session, self._channel, self._slot = session, channel, slot
        shape = (length,) if channel.mode.format is PixelFormat.MJPEG else channel.shape
        interface = {"version": 3, "data": (slot.address, False), "typestr": channel.dtype.str, "shape": shape}
        # The publisher keeps the memory mapped, also for an array that outlives the session.
        self.array = np.asarray(_Owner(channel.sender, interface))

    def send(
        self,
        *,
        device_time: int | None = None,
        device_sequence: int = 0,
        arrival_ns: int | None = None,
        exposure_ns: int = 0,
        gain: float = 0.0,
        temperature_c: float = float("nan"),
        damaged: bool = False,
        triggered: bool = False,
    ) -> bool:
        """Send the frame with the facts of :meth:`ExternalSession.send`; return false when nobody has received it."""
        session, channel, slot = self._session, self._channel, self._slot
        if session._over:
            return False
        mode = channel.mode
        flags = 0
        if device_time is None and mode.clock is not ExternalClock.ARRIVAL:
            flags |= ExternalFrameFlags.METADATA_LOST
        if damaged:
            flags |= ExternalFrameFlags.DAMAGED
        if triggered:
            flags |= ExternalFrameFlags.HARDWARE_TRIGGERED
        head = _FRAME_HEAD.pack(
            layout.EXTERNAL_FRAME_MAGIC,
            layout.EXTERNAL_VERSION,
            layout.EXTERNAL_FRAME_SIZE,
            session._camera._instance,
            session.number,
            channel.sequence,
            device_sequence & 0xFFFF_FFFF_FFFF_FFFF,
            (device_time or 0) & 0xFFFF_FFFF_FFFF_FFFF,
            time.monotonic_ns() if arrival_ns is None else arrival_ns,
            max(0, exposure_ns),
            gain,
            temperature_c,
            int(mode.format),
            mode.width,
            mode.height,
            slot.length,
            int(flags),
            0,
        )
        ctypes.memmove(slot.header_address, head, len(head))
        received = slot.send()
        session._camera._bell.ring()
        return received > 0
