"""Reading a signal: its newest sample, a window of samples, and its value at the time of an image."""

from __future__ import annotations

import ctypes
import time
from bisect import bisect_left
from typing import Any

from . import _layout as layout
from ._bus import Bus, Receiver
from ._layout import SignalFlags
from ._ports import SIGNAL
from ._reader import LIVENESS_S, SLICE_S
from ._runtime import PathLike, runtime_dir
from ._signal import HEAD, published
from ._signal_description import SignalDescription, fnv, parse_description
from ._signal_sample import SignalSample, SignalWindow, between, check_values
from .errors import (
    BadSignal,
    BusError,
    SignalChanged,
    SignalGap,
    SignalNotFound,
    SignalOutside,
    Stale,
    StreamGone,
    Timeout,
    VersionMismatch,
)

# Bytes that the samples of one reader take at most.
_MAX_BYTES = 64 << 20
# Taken at a time, so that a publisher without a rate does not keep a reader.
_AT_A_TIME = 4 * layout.SIGNAL_BUFFER
# Samples that are no longer needed are deleted in blocks.
_BLOCK = 1024
_VERSION = (layout.SIGNAL_MAGIC, layout.SIGNAL_VERSION, layout.SIGNAL_HEADER_SIZE)


class SignalReader:
    """Reads a signal: `SignalReader("arm/joint_position")`.

    It keeps the samples of the last `keep` seconds. Up to 512 unread samples wait for it; older ones are replaced and
    counted in :attr:`missed`, so at 1 kHz call one of its methods at least twice a second. `timeout` is how many seconds to
    wait for the signal to appear. `runtime_dir` is the runtime folder, by default that of this user.

    Another publisher begins a new series of samples, counted in :attr:`restarts`; if its fields are others, each method
    raises SignalChanged once and then goes on with them. One thread at a time may read.
    """

    def __init__(
        self, name: str, runtime_dir: PathLike | None = None, timeout: float = 2.0, *, keep: float = 10.0
    ) -> None:
        self._receiver: Receiver | None = None
        if not name.count("/") == 1:
            raise ValueError(f"invalid signal name {name!r}: write DEVICE/SIGNAL, such as arm/joint_position")
        self.name = name
        self._keep_ns = int(keep * 1e9)
        self._description: SignalDescription | None = None
        self._samples: list[SignalSample] = []
        self._times: list[int] = []
        self._first = 0
        self._bytes = 0
        self._session = 0
        self._sequence = 0
        self._missed = 0
        self._restarts = 0
        folder = _runtime_dir(runtime_dir)

        def missing() -> SignalNotFound:
            names = ", ".join(published(folder)) or "none"
            return SignalNotFound(f"signal {name}: nobody publishes it; published in {folder}: {names}")

        deadline = time.monotonic() + timeout
        while True:
            try:
                bus = Bus.at(folder)
                bus.clean_dead()  # killed readers hold places
                channel = f"{layout.SIGNAL_PREFIX}/{name}"
                what = f"signal {name}"
                self._receiver = Receiver(bus, channel, layout.SIGNAL_SCHEMA, SIGNAL, what, missing)
                return
            except SignalNotFound:
                if time.monotonic() >= deadline:
                    raise
            time.sleep(0.02)

    @property
    def description(self) -> SignalDescription | None:
        """Name, kind and fields of the signal; None until a sample has come."""
        return self._description

    @property
    def missed(self) -> int:
        """Samples that were published but did not reach this reader."""
        return self._missed

    @property
    def restarts(self) -> int:
        """How often another publisher took over."""
        return self._restarts

    @property
    def is_live(self) -> bool:
        """Whether the signal has a publisher now."""
        return self._open.has_publisher()

    def latest(self, max_age: float | None = None) -> SignalSample | None:
        """Return the newest sample, also if it was returned before; None when none has come yet.

        With `max_age` it raises Stale instead of returning None or a sample that was measured more than so many seconds
        ago. Samples of a replay carry the times of their recording, have no age, and raise Stale.
        """
        self._fill()
        newest = self._samples[-1] if self._samples else None
        if max_age is None:
            return newest
        if newest is None:
            raise Stale(f"signal {self.name}: no sample has come yet, and one of {max_age:g} s is needed", None, max_age)
        if newest.replayed:
            raise Stale(f"signal {self.name}: it is replayed, its samples have no age", None, max_age)
        age = newest.age_s
        if age > max_age:
            raise Stale(
                f"signal {self.name}: its newest sample is {age:.3f} s old, at most {max_age:g} s is allowed", age, max_age
            )
        return newest

    def window(self, seconds: float) -> SignalWindow:
        """Return the samples of the last `seconds` before the newest one, which is the last of them.

        Raises SignalOutside when no sample has come yet.
        """
        self._fill()
        if not self._samples or self._description is None:
            raise SignalOutside(f"signal {self.name}: no sample has come yet")
        first = bisect_left(self._times, self._times[-1] - int(seconds * 1e9), self._first)
        return SignalWindow(self._description, self._times[first:], [s.raw for s in self._samples[first:]])

    def at(self, time_ns: int, max_gap: float) -> SignalSample:
        """Return the sample at `time_ns`, such as an image's `header.capture_time_ns`: a published one, or one between two.

        Floats are linear, the rotation of a pose follows the shorter arc, and integers, bools and texts are those of the
        sample before. A signal whose second derivative is at most a is then off by at most a · `max_gap`² / 8.

        Raises SignalGap when the two samples are more than `max_gap` seconds apart. Raises SignalOutside when the time is
        before the first sample that is kept or after the newest one: wait for the next sample, nothing is extrapolated.
        """
        self._fill()
        times = self._times
        index = bisect_left(times, time_ns, self._first)
        if index < len(times) and times[index] == time_ns:
            return self._samples[index]
        if index == len(times) or index == self._first:
            raise self._outside(time_ns)
        gap_ns = times[index] - times[index - 1]
        if gap_ns > max_gap * 1e9:
            raise SignalGap(
                f"signal {self.name}: the samples around {time_ns} ns are {gap_ns / 1e6:.3f} ms apart, at most "
                f"{max_gap * 1e3:.3f} ms are allowed",
                gap_ns / 1e9,
            )
        return between(self._samples[index - 1], self._samples[index], time_ns)

    def _after(self, time_ns: int) -> int | None:
        """Return the time of the first sample taken in that is not before `time_ns`; None when there is none."""
        index = bisect_left(self._times, time_ns, self._first)
        return self._times[index] if index < len(self._times) else None

    def wait(self, timeout: float | None = None) -> SignalSample:
        """Wait up to `timeout` seconds (None: as long as it takes) for an unread sample and return the newest one.

        Raises Timeout when none came in time, and StreamGone when the publisher has gone; ask again to go on with one
        that came back.
        """
        started = time.monotonic()
        deadline = float("inf") if timeout is None else started + timeout
        look = started + LIVENESS_S
        while not self._fill():
            now = time.monotonic()
            if now >= look:
                if not self._open.has_publisher():
                    raise StreamGone(f"signal {self.name}: nobody publishes it any more")
                look = now + LIVENESS_S
            if now >= deadline:
                raise Timeout(f"signal {self.name}: nothing came within {timeout:g} s")
            self._open.wait(min(SLICE_S, deadline - now, look - now))
        return self._samples[-1]

    @property
    def _open(self) -> Receiver:
        if self._receiver is None:
            raise ValueError(f"the reader of signal {self.name} was closed")
        return self._receiver

    def _outside(self, time_ns: int) -> SignalOutside:
        if not self._samples:
            return SignalOutside(f"signal {self.name}: no sample has come yet")
        first, newest = self._times[self._first], self._times[-1]
        if time_ns < first:
            where = f"{(first - time_ns) / 1e6:.3f} ms before the first sample that is kept"
        else:
            where = f"{(time_ns - newest) / 1e6:.3f} ms after the newest sample"
        return SignalOutside(f"signal {self.name}: {time_ns} ns is {where}")

    def _fill(self) -> int:
        """Take in all unread samples and return how many."""
        receiver = self._open
        taken = 0
        while taken < _AT_A_TIME:
            received = receiver.receive()
            if received is None:
                break
            # Copied at once, so that the slot is free again.
            head = HEAD.unpack(ctypes.string_at(received.user_header_ptr, layout.SIGNAL_HEADER_SIZE))
            payload = ctypes.string_at(received.payload_ptr, received.header.number_of_elements)
            del received
            taken += self._take(head, payload)
        return taken

    def _take(self, head: tuple[Any, ...], payload: bytes) -> bool:
        """Take in one sample; return whether it was kept."""
        what = f"signal {self.name}"
        if head[:3] != _VERSION:
            raise VersionMismatch(
                f"{what}: a sample has header version {head[1]}, this package reads version {layout.SIGNAL_VERSION}; install "
                "the `depthrig` package of the publisher's version"
            )
        sequence, session, time_ns, publish_time_ns, uncertainty_ns, digest, length, payload_len, flags = head[3:12]
        start = length + -length % 8
        if length > layout.SIGNAL_MAX_DESCRIPTION_BYTES or len(payload) != payload_len or len(payload) < start:
            raise BadSignal(f"{what}: invalid sample: its description or its payload has not the length that it states")
        known = self._description
        description = known
        if known is None or known.hash != digest:
            text = payload[:length]
            description = parse_description(text, what)
            if fnv(text) != digest:
                raise BadSignal(f"{what}: invalid sample: its description has another hash than the header states")
            if known is not None and known.same(description):
                description = known
        assert description is not None
        raw = payload[start:]
        check_values(description, raw, what)
        if session < self._session:
            # It comes behind one of the next publisher: a remnant, which would break the order.
            self._missed += 1
            return False
        if session > self._session:
            if self._session > 0:
                # A reader that was there before gets all of a new publisher.
                self._restarts += 1
                self._missed += max(0, sequence - 1)
            self._session = session
            self._forget()
        else:
            self._missed += max(0, sequence - self._sequence - 1)
        self._sequence = sequence
        if self._times and time_ns <= self._times[-1]:  # a replay that went back
            self._forget()
        self._description = description
        self._keep(
            SignalSample(
                description, sequence, session, time_ns, publish_time_ns, uncertainty_ns, SignalFlags(flags), raw
            )
        )
        if known is not None and known is not description:
            raise SignalChanged(
                f"{what}: another publisher took over with a different description: {_fields(description)}; before: "
                f"{_fields(known)}; read on to go on with it"
            )
        return True

    def _keep(self, sample: SignalSample) -> None:
        self._samples.append(sample)
        self._times.append(sample.time_ns)
        self._bytes += len(sample.raw)
        times, oldest = self._times, sample.time_ns - self._keep_ns
        while times[self._first] < oldest or (self._bytes > _MAX_BYTES and self._first + 1 < len(times)):
            self._bytes -= len(self._samples[self._first].raw)
            self._first += 1
        if self._first >= _BLOCK and self._first * 2 > len(times):
            del self._samples[: self._first], times[: self._first]
            self._first = 0

    def _forget(self) -> None:
        self._samples.clear()
        self._times.clear()
        self._first = self._bytes = 0

    def close(self) -> None:
        """Stop reading. Samples and windows stay valid."""
        if self._receiver is not None:
            self._receiver.close()
            self._receiver = None

    def __enter__(self) -> SignalReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._receiver is None else f"at #{self._sequence}, {self._missed} missed"
        return f"<SignalReader {self.name}, {state}>"


def _fields(description: SignalDescription) -> str:
    return f"{', '.join(field.name for field in description.fields)} ({description.kind})"


_runtime_dir = runtime_dir
