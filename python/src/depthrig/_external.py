"""Serving a camera to the daemon from this process: the Python side of docs/external.md.

A thread of its own exchanges heartbeats with the daemon; the program asks for sessions and sends frames. A session is
one start of the camera in given modes, until the daemon stops it or is gone.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import secrets
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

from . import _layout as layout
from ._bus import Bus
from ._external_answer import Answer, read_answer
from ._external_mode import ExternalMode
from ._external_session import ExternalSession
from ._header import blank_fields, pack_fields
from ._layout import ExternalReason, ExternalState, ExternalWant
from ._ports import ANSWER, OFFER, TALK, Bell, Letters, Sender
from ._runtime import PathLike, check_name, pick_rig, runtime_dir, take_lock
from .errors import BusError, CameraRefused, CameraServed, RigNotRunning

# A channel whose other end was just killed may need to be cleaned up first.
_ENDED_GRACE_S = 0.05
# Answers that are read at a time; the channel keeps no more.
_ANSWERS_AT_A_TIME = 64
# One being written, the unread and held ones of each subscriber, and one that is kept for latecomers.
_OFFER_SLOTS = 24


class ExternalCamera:
    """A camera of a rig whose frames come from this process.

    >>> modes = [depthrig.ExternalMode("color", depthrig.PixelFormat.RGB8, 640, 480, 30.0)]
    >>> with depthrig.ExternalCamera("front", modes, model="X1", serial="1234") as camera:
    ...     for session in camera.sessions():
    ...         with session, sdk.start() as device:
    ...             while session.wanted:
    ...                 session.send("color", device.image())

    `name` is the camera's name in the rig file and `rig` that of the rig: by default those that the daemon set when
    it started this process, else the only running rig. `modes` are the camera's modes; the first one of a stream is
    its default. `calibration` says where it comes from (`factory`, `file x.json`, `none`), `port` where the camera is
    attached. One process serves a camera; CameraServed names it.

    The daemon may come and go: this object goes on offering, and :meth:`sessions` has the next session when it is
    back. The methods are for one thread, but for :meth:`stop`, which any thread and any signal handler may call.
    """

    def __init__(
        self,
        name: str | None,
        modes: Sequence[ExternalMode],
        *,
        model: str,
        serial: str,
        firmware: str = "",
        port: str = "",
        calibration: str = "none",
        program: str | None = None,
        rig: str | None = None,
        runtime_dir: PathLike | None = None,
    ) -> None:
        self._closed = True  # until it is open, there is nothing to close
        if name is None:
            name = os.environ.get(layout.EXTERNAL_CAMERA_VARIABLE)
            if name is None:
                raise ValueError("which camera of the rig? Name it, or let the daemon start this program")
        self.name = check_name(name, "camera")
        self.modes = _checked(modes)
        if not model:
            raise ValueError(f"camera {name!r}: what model is it? The daemon takes none without a name")
        folder = _runtime_dir(runtime_dir)
        try:
            self.rig = pick_rig(folder, rig if rig is not None else os.environ.get(layout.EXTERNAL_RIG_VARIABLE))
        except RigNotRunning as e:
            raise RigNotRunning(f"{e}, or name the rig with rig=…: then this camera may come first") from None
        self._pid = os.getpid()
        self._program = program or os.path.basename(sys.argv[0]) or "python"
        self._lock = _lock(folder, self.rig, self.name, self._program)
        try:
            self._bus = Bus.at(folder)
            # Remains of killed processes count against the limits of the channels.
            self._bus.clean_dead()
            prefix = f"{layout.EXTERNAL_PREFIX}/{self.rig}/{self.name}"
            self._prefix = prefix
            length = len(self.modes) * layout.EXTERNAL_MODE_SIZE
            self._letters = Letters(self._bus, f"{prefix}/answer", ANSWER, layout.EXTERNAL_ANSWER_SIZE)
            self._offers = Sender(self._bus, f"{prefix}/offer", OFFER, length, _OFFER_SLOTS, TALK)
            self._bell = Bell(self._bus, f"{prefix}/offer", TALK)
            self._wake = Bell(self._bus, f"{prefix}/answer", TALK)
        except BaseException:
            os.close(self._lock)
            raise
        self._identity = {
            "model": _text(model, 32),
            "serial": _text(serial, 32),
            "firmware": _text(firmware, 32),
            "port": _text(port, 32),
            "calibration": _text(calibration, 32),
            "program": _text(self._program, 32),
        }
        self._payload = b"".join(mode.pack() for mode in self.modes)
        self._instance = secrets.randbits(63) | 1
        self._changed = threading.Condition()
        self._number = 0
        self._taken = 0
        self._about = 0
        self._state = (ExternalState.IDLE, ExternalReason.NONE, "")
        self._answer: Answer | None = None
        self._failure: BaseException | None = None
        self._stopped = False
        self._refused_session: int | None = None
        self._current: ExternalSession | None = None
        self._thread = threading.Thread(target=self._beat, name=f"depthrig {self.name}", daemon=True)
        self._closed = False
        self._thread.start()
        self._send_offer()

    # The heartbeat thread.

    def _beat(self) -> None:
        """Exchange heartbeats until the camera is closed."""
        due = time.monotonic() + layout.EXTERNAL_HEARTBEAT_S
        try:
            while not self._closed:
                self._letters.wait(min(max(due - time.monotonic(), 0.0), layout.EXTERNAL_HEARTBEAT_S))
                self._read_answers()
                if time.monotonic() >= due and not self._closed:
                    self._send_offer()
                    due = time.monotonic() + layout.EXTERNAL_HEARTBEAT_S
        except BaseException as e:
            with self._changed:
                self._failure = e
                self._changed.notify_all()

    def _read_answers(self) -> None:
        newest = None
        # No more than that at a time: a flooded channel must not delay the heartbeat.
        for _ in range(_ANSWERS_AT_A_TIME):
            message = self._letters.take()
            if message is None:
                break
            newest = read_answer(message, self._instance, len(self.modes)) or newest
        if newest is not None:
            with self._changed:
                # If two answer, such as an abandoned thread of the daemon, the later session counts.
                known = self._answer.session if self._answer is not None else 0
                if 0 < newest.session < known:
                    return
                self._answer = newest
                self._changed.notify_all()

    def _send_offer(self) -> None:
        """Send this process's state, from any thread."""
        with self._changed:
            slot = self._offers.loan(len(self._payload))
            if slot is None:
                return  # the next heartbeat carries it
            self._number += 1
            state, reason, text = self._state
            values = {
                **blank_fields(layout.EXTERNAL_OFFER_FIELDS),
                **self._identity,
                "magic": layout.EXTERNAL_OFFER_MAGIC,
                "version": layout.EXTERNAL_VERSION,
                "size": layout.EXTERNAL_OFFER_SIZE,
                "instance": self._instance,
                "number": self._number,
                "sent_ns": time.monotonic_ns(),
                "session": self._about,
                "state": int(state),
                "reason": int(reason),
                "modes": len(self.modes),
                "pid": self._pid,
                "text": _text(text, layout.EXTERNAL_TEXT_SIZE),
            }
            head = pack_fields(layout.EXTERNAL_OFFER_FIELDS, layout.EXTERNAL_OFFER_SIZE, values)
            ctypes.memmove(slot.header_address, head, len(head))
            ctypes.memmove(slot.address, self._payload, len(self._payload))
            slot.send()
        self._bell.ring()

    def _set_state(
        self,
        state: ExternalState,
        reason: ExternalReason = ExternalReason.NONE,
        text: str = "",
        session: int | None = None,
    ) -> None:
        with self._changed:
            self._state = (state, reason, text)
            self._about = self._taken if session is None else session
        self._send_offer()

    # The program's side.

    def wait(self, timeout: float | None = None) -> ExternalSession | None:
        """Wait up to `timeout` seconds (None: as long as it takes) for a session.

        Returns None when none came, or after :meth:`stop`.
        Raises CameraRefused, with the daemon's message, when it refuses this camera's offer.
        """
        self._check()
        if self._current is not None:
            raise ValueError("the session before is not over yet; leave it with session.close() or its `with` block")
        deadline = float("inf") if timeout is None else time.monotonic() + timeout
        with self._changed:
            while not self._stopped:
                if self._failure is not None:
                    raise BusError(f"camera {self.name!r} lost touch with the bus ({self._failure})") from self._failure
                answer = self._answer
                if answer is not None and answer.fresh:
                    if answer.want is ExternalWant.RUN and answer.session > self._taken:
                        self._taken = answer.session
                        self._current = ExternalSession(self, answer)
                        break
                    if answer.want is ExternalWant.REFUSED and answer.session != self._refused_session:
                        if answer.session and answer.session <= self._taken:
                            self._refused_session = answer.session  # of a session that is over; there may be another
                        else:
                            raise CameraRefused(
                                f"rig {self.rig!r} refuses camera {self.name!r}: {answer.text or answer.reason_name}"
                            )
                rest = deadline - time.monotonic()
                if rest <= 0:
                    return None
                # In slices, so that Python handles signals meanwhile.
                self._changed.wait(min(rest, 0.1))
        if self._current is not None:
            self._set_state(ExternalState.STARTING)
        return self._current

    def _wait_for_stop(self, number: int, timeout: float) -> bool:
        """Wait until the daemon ends session `number`; return whether it did."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while self._failure is None and not self._stopped:
                answer = self._answer
                if answer is not None and (answer.session, answer.want) == (number, ExternalWant.STOP):
                    return True
                rest = deadline - time.monotonic()
                if rest <= 0:
                    break
                self._changed.wait(min(rest, 0.1))
        return False

    def sessions(self) -> Iterator[ExternalSession]:
        """Yield each session as the daemon asks for it, until :meth:`stop`. One that was left open is closed."""
        while True:
            session = self.wait()
            if session is None:
                return
            try:
                yield session
            finally:
                session.close()

    def unavailable(self, text: str, reason: ExternalReason = ExternalReason.NOT_FOUND) -> None:
        """Report that the camera is unavailable, and why: unplugged, or held by another process. The process stays."""
        self._check()
        self._set_state(ExternalState.REFUSED, reason, text, 0)

    def available(self) -> None:
        """Report that the camera is available again."""
        self._check()
        self._set_state(ExternalState.IDLE, session=0)

    def stop(self) -> None:
        """End :meth:`wait`, :meth:`sessions` and the session. Safe in a signal handler."""
        self._stopped = True

    @property
    def stopped(self) -> bool:
        """Whether :meth:`stop` was called."""
        return self._stopped

    def close(self, reason: ExternalReason = ExternalReason.NONE, text: str = "") -> None:
        """Free the camera and report why, which the daemon shows. FINISHED is for files at their end."""
        if self._closed:
            return
        if self._current is not None:
            self._current.close()
        self._closed = True
        if os.getpid() != self._pid:  # the lock and the channels are the parent's
            return
        with contextlib.suppress(BusError):
            self._wake.ring()
        self._thread.join(1.0)
        with contextlib.suppress(BusError):
            self._set_state(ExternalState.ENDED, reason, text)
            # The daemon must read the message before its sender and the memory are gone.
            time.sleep(_ENDED_GRACE_S)
        os.close(self._lock)

    def __enter__(self) -> ExternalCamera:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, _: Any) -> None:
        if error is None or isinstance(error, (KeyboardInterrupt, SystemExit, GeneratorExit)):
            self.close()
        else:
            self.close(ExternalReason.DEVICE, f"{type(error).__name__}: {error}")

    def __del__(self) -> None:
        if not self._closed:
            self.close()

    def _check(self) -> None:
        if self._closed:
            raise ValueError(f"camera {self.name!r} was closed")
        if os.getpid() != self._pid:
            raise BusError(f"camera {self.name!r} was opened before this process was forked; serve it in one process")

    def __repr__(self) -> str:
        state = "closed" if self._closed else self._state[0].name.lower()
        return f"<ExternalCamera {self.name} of rig {self.rig!r}, {state}>"


def _checked(modes: Sequence[ExternalMode]) -> tuple[ExternalMode, ...]:
    """Return the modes, unless there are more than the daemon accepts."""
    streams = {mode.stream for mode in modes}
    if not 0 < len(modes) <= layout.EXTERNAL_MAX_MODES or len(streams) > layout.EXTERNAL_MAX_STREAMS:
        raise ValueError(
            f"a camera has 1 to {layout.EXTERNAL_MAX_MODES} modes of at most {layout.EXTERNAL_MAX_STREAMS} streams, "
            f"not {len(modes)} of {len(streams)}"
        )
    return tuple(modes)


def _text(text: str, size: int) -> bytes:
    """Return text for a field: without control characters, cut where a character ends, with a zero byte behind it."""
    cleaned = "".join(c if c.isprintable() else " " for c in text)
    return cleaned.encode("utf-8", "replace")[: size - 1].decode("utf-8", "ignore").encode()


def _lock(folder: str, rig: str, camera: str, program: str) -> int:
    """Take the right to serve the camera; returns the file."""
    taken = take_lock(os.path.join(folder, f"{rig}.{camera}{layout.EXTERNAL_LOCK_SUFFIX}"), program)
    if isinstance(taken, str):
        raise CameraServed(
            f"camera {camera!r} of rig {rig!r} is served already, by {taken}; end that first, or serve another camera"
        )
    return taken


_runtime_dir = runtime_dir
