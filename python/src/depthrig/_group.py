"""Reading several streams at one moment: the frames of each that are nearest in capture time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from ._frame import Frame
from ._reader import LIVENESS_S, SLICE_S
from ._runtime import PathLike
from ._stream import Stream
from .errors import HoldingTooMany, Stale, StreamGone, Timeout

if TYPE_CHECKING:
    import torch

# Frames of each stream that a reader keeps to choose from, of the 16 that a subscriber may hold: as many as a stream of
# 30 Hz is ahead of one whose refining takes a quarter of a second.
KEPT = 8
_NEVER = -(1 << 63)


class FrameGroup(Mapping[str, Frame]):
    """Frames of several streams that belong to one moment, by the name of their stream.

    A stream without a frame in this group is in :attr:`missing`, and asking for it is a KeyError. Each frame keeps its
    slot until it, its arrays and the group are gone.
    """

    __slots__ = ("_frames", "missing")

    def __init__(self, frames: dict[str, Frame], missing: tuple[str, ...]) -> None:
        self._frames = frames
        self.missing = missing
        """Streams that have no frame in this group; empty when it is complete."""

    @property
    def is_complete(self) -> bool:
        """Whether every stream has a frame."""
        return not self.missing

    @property
    def skew_s(self) -> float:
        """Seconds between the earliest and the latest exposure of the frames that are there."""
        times = [f.capture_time_ns for f in self._frames.values()]
        return (max(times) - min(times)) / 1e9

    @property
    def age_s(self) -> float:
        """Seconds since the middle of the oldest frame's exposure."""
        return max(f.age_s for f in self._frames.values())

    @property
    def capture_times_ns(self) -> dict[str, int]:
        """Capture time of each frame that is there, nanoseconds on CLOCK_MONOTONIC."""
        return {name: f.capture_time_ns for name, f in self._frames.items()}

    def torch(self, device: str | torch.device = "cpu", *, metres: bool = False) -> dict[str, torch.Tensor]:
        """Return the pixels of each frame as a tensor; see :meth:`Frame.torch`."""
        return {name: f.torch(device, metres=metres) for name, f in self._frames.items()}

    def release(self) -> None:
        """Release the pixels of all frames now; see :meth:`Frame.release`."""
        for frame in self._frames.values():
            frame.release()

    def __enter__(self) -> FrameGroup:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __getitem__(self, stream: str) -> Frame:
        if stream in self.missing:
            raise KeyError(f"{stream} has no frame in this group: look at `missing` first")
        return self._frames[stream]

    def __iter__(self) -> Iterator[str]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __repr__(self) -> str:
        missing = f", missing {', '.join(self.missing)}" if self.missing else ""
        return f"<FrameGroup of {', '.join(self._frames)}, skew {self.skew_s * 1e3:.1f} ms{missing}>"


class SetReader:
    """Several streams at one time: `SetReader(["d435/depth_refined", "d405/depth_refined"])`.

    A group is formed for the newest moment that every stream has reached: of each stream the frame whose capture time
    is nearest to it. Groups are the newest there are; moments that a slow reader has missed are skipped. Every group is
    newer than the one before, and a frame is in one group at most. Where the frames that come next will more than halve
    the skew, the group waits for them.

    `max_skew`: seconds that the frames of a group may lie apart at most; frames that are further apart make no group.
    Two cameras that run freely at 30 Hz are up to 22 ms apart; stages that refine at 5 Hz, up to 100 ms.

    `partial_after`: None gives complete groups only. A number of seconds gives, when no complete group came for so
    long, those frames that there are, and names the others in :attr:`FrameGroup.missing`. It must be longer than the
    slowest stream is behind the fastest, else that one is always missing.

    `rig`, `runtime_dir` and `timeout` as for :class:`depthrig.Stream`. It keeps up to 8 frames of each stream to choose
    from, which leaves 8 to hold. One thread at a time may read.
    """

    def __init__(
        self,
        streams: Iterable[str],
        rig: str | None = None,
        runtime_dir: PathLike | None = None,
        timeout: float = 2.0,
        *,
        max_skew: float = 0.05,
        partial_after: float | None = None,
    ) -> None:
        names = list(streams)
        if isinstance(streams, str) or not names or len(set(names)) != len(names):
            raise ValueError(f"{streams!r}: give a list of streams such as ['d435/depth', 'd405/depth'], each once")
        self._max_skew_ns = int(max_skew * 1e9)
        self._partial_after = partial_after
        self._moment_ns = _NEVER
        # Of each stream the capture time of the newest frame that came, how long after the one before it was, and the
        # capture time of the newest that is in a group.
        self._reached: dict[str, int] = {}
        self._period: dict[str, int] = {}
        self._given: dict[str, int] = {}
        self._skew_seen_ns: int | None = None
        self._kept: dict[str, deque[Frame]] = {name: deque() for name in names}
        self._streams: dict[str, Stream] = {}
        deadline = time.monotonic() + timeout
        try:
            for name in names:
                left = max(0.0, deadline - time.monotonic())
                self._streams[name] = Stream(name, rig, runtime_dir, left)
                rig = self._streams[name].rig
        except BaseException:
            self.close()
            raise
        self.rig = rig
        """The rig's name."""

    @property
    def streams(self) -> list[str]:
        """The streams that are read."""
        return list(self._kept)

    @property
    def missed(self) -> dict[str, int]:
        """For each stream the frames that were replaced before they were read."""
        return {name: s.missed for name, s in self._streams.items()}

    @property
    def restarts(self) -> dict[str, int]:
        """For each stream how often its numbering began anew."""
        return {name: s.restarts for name, s in self._streams.items()}

    def latest(self) -> FrameGroup | None:
        """Return the newest complete group that is newer than the last one; None when there is none."""
        self._drain()
        return self._complete()

    def next(self, timeout: float | None = None) -> FrameGroup:
        """Return the newest group that is newer than the last one, waiting for it up to `timeout` seconds.

        Raises Timeout, which names the missing streams, and StreamGone when one of them (with `partial_after`: each of
        them) has no publisher any more. After either, the same object can be asked again.
        """
        return self._wait(timeout, None)

    def wait_fresh(self, max_age: float, timeout: float | None = None) -> FrameGroup:
        """Return a group whose oldest frame's exposure is at most `max_age` seconds ago, waiting for one if need be.

        As :meth:`depthrig.Stream.wait_fresh`: up to `timeout` seconds, by default `max_age`, then Stale with the age.
        """
        if not max_age > 0:
            raise ValueError(f"max_age is a number of seconds above 0, not {max_age!r}")
        return self._wait(max_age if timeout is None else timeout, max_age)

    def _wait(self, timeout: float | None, max_age: float | None) -> FrameGroup:
        started = time.monotonic()
        deadline = float("inf") if timeout is None else started + timeout
        partial = float("inf") if self._partial_after is None else started + self._partial_after
        look = started + LIVENESS_S
        while True:
            self._drain()
            group = self._complete()
            now = time.monotonic()
            if group is None and now >= partial:
                group = self._incomplete()
            if group is not None:
                if max_age is None:
                    return group
                self._refuse_replay(group, max_age)
                if group.age_s <= max_age:
                    return group
                group = None  # gives its slots back
            over = now >= deadline
            if over or now >= look:
                self._check_publishers()
                look = now + LIVENESS_S
            if over:
                raise self._timeout(timeout or 0.0) if max_age is None else self._stale(max_age)
            until = min(SLICE_S, deadline - now, look - now)
            # Behind the moment from which a group may be partial, any stream may bring it; asked often enough.
            until = min(until, partial - now) if now < partial else min(until, 0.005)
            self._laggard()._pause(until)

    def _drain(self) -> None:
        """Read new frames, and keep the newest of each stream."""
        if not self._streams:
            raise ValueError("it was closed")
        for name, stream in self._streams.items():
            kept = self._kept[name]
            while True:
                try:
                    frame = stream._take()
                except HoldingTooMany:
                    if not kept:
                        raise
                    kept.popleft()
                    continue
                if frame is None:
                    break
                if frame.is_motion:
                    raise TypeError(
                        f"{name} carries IMU samples, which belong to no moment: read it with depthrig.Stream, and "
                        "choose samples by their time_ns"
                    )
                if frame.capture_time_ns <= self._reached.get(name, _NEVER):
                    # A replay that was wound back, or a computer's clock after a restart: begin anew.
                    kept.clear()
                    self._moment_ns = _NEVER
                    self._given.clear()
                self._period[name] = frame.capture_time_ns - self._reached.get(name, _NEVER)
                self._reached[name] = frame.capture_time_ns
                kept.append(frame)
                if len(kept) > KEPT:
                    kept.popleft()

    def _complete(self) -> FrameGroup | None:
        if not all(self._kept.values()):
            return None
        moment = min(kept[-1].capture_time_ns for kept in self._kept.values())
        if moment <= self._moment_ns:
            return None
        return self._group(moment, dict(self._kept), may_wait=True)

    def _incomplete(self) -> FrameGroup | None:
        """Return the frames of the newest moment that any stream has reached, from those streams that have one."""
        unread = {n: k for n, k in self._kept.items() if k and k[-1].capture_time_ns > self._given.get(n, _NEVER)}
        if not unread:
            return None
        moment = max(kept[-1].capture_time_ns for kept in unread.values())
        near = {n: k for n, k in unread.items() if moment - k[-1].capture_time_ns <= self._max_skew_ns}
        return self._group(moment, near, may_wait=False)

    def _group(self, moment: int, kept: dict[str, deque[Frame]], *, may_wait: bool) -> FrameGroup | None:
        frames = {n: min(k, key=lambda f: abs(f.capture_time_ns - moment)) for n, k in kept.items()}
        times = {n: f.capture_time_ns for n, f in frames.items()}
        self._skew_seen_ns = max(times.values()) - min(times.values())
        if self._skew_seen_ns > self._max_skew_ns or (may_wait and self._is_early(times)):
            return None
        self._moment_ns = max(self._moment_ns, moment)
        self._given.update(times)
        for name, k in self._kept.items():
            # Older frames can be in no later group.
            while k and k[0].capture_time_ns <= self._given.get(name, _NEVER):
                k.popleft()
        return FrameGroup(frames, tuple(n for n in self._kept if n not in frames))

    def _is_early(self, times: dict[str, int]) -> bool:
        """Return whether the frames that come next will more than halve the skew.

        A stream that is a frame ahead of the others, as after a lost frame, would stay so: each frame is in one group.
        In a simulation of 2 to 4 cameras with random phases and delays, this halves the skews and leaves out 1 % of the groups.
        """
        latest = max(times.values())
        nearest = []
        for name, kept in self._kept.items():
            later = [f.capture_time_ns for f in kept if f.capture_time_ns >= times[name]]
            due = self._reached[name] + self._period[name]
            nearest.append(min(*later, due, key=lambda t: abs(t - latest)))
        return 2 * (max(nearest) - min(nearest)) < latest - min(times.values())

    def _laggard(self) -> Stream:
        """Return the stream without which there is no complete group."""
        return self._streams[min(self._kept, key=lambda name: self._reached.get(name, _NEVER))]

    def _check_publishers(self) -> None:
        gone = [n for n, s in self._streams.items() if not s.is_live]
        if gone and (self._partial_after is None or len(gone) == len(self._streams)):
            raise StreamGone(
                f"{', '.join(gone)} of rig {self.rig!r}: nobody publishes it any more; is the daemon running "
                "(`depthrig status`)?"
            )

    def _lacking(self) -> str:
        lacking = [n for n, k in self._kept.items() if not k]
        if lacking:
            return f"nothing new of {', '.join(lacking)}"
        if self._skew_seen_ns is not None and self._skew_seen_ns > self._max_skew_ns:
            return (
                f"the nearest frames are {self._skew_seen_ns / 1e6:.1f} ms apart, more than "
                f"{self._max_skew_ns / 1e6:.1f} ms (max_skew)"
            )
        return "nothing new"

    def _timeout(self, timeout: float) -> Timeout:
        return Timeout(
            f"{len(self._streams)} streams of rig {self.rig!r}: no group within {timeout:g} s: {self._lacking()}; "
            "`depthrig status` shows what the cameras are doing"
        )

    def _stale(self, max_age: float) -> Stale:
        newest = {n: s._newest_ns for n, s in self._streams.items()}
        what = f"{len(self._streams)} streams of rig {self.rig!r}"
        never = [n for n, ns in newest.items() if ns is None]
        if never:
            return Stale(f"{what}: no frame of {', '.join(never)} has come yet", None, max_age)
        oldest = min(newest, key=lambda n: newest[n] or 0)
        age = (time.monotonic_ns() - (newest[oldest] or 0)) / 1e9
        return Stale(
            f"{what}: the newest frame of {oldest} is {age:.3f} s old, at most {max_age:g} s is allowed "
            f"({self._lacking()}); `depthrig status` shows what the cameras are doing",
            age,
            max_age,
        )

    def _refuse_replay(self, group: FrameGroup, max_age: float) -> None:
        if any(f.replayed for f in group.values()):
            raise Stale(
                f"rig {self.rig!r} is a replay: its frames carry the times of the recording and have no age; read it "
                "with next()",
                None,
                max_age,
            )

    def close(self) -> None:
        """Stop subscribing. Frames and arrays that are held stay valid."""
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        for kept in self._kept.values():
            kept.clear()

    def __enter__(self) -> SetReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> SetReader:
        return self

    def __next__(self) -> FrameGroup:
        if not self._streams:
            raise StopIteration
        return self.next()

    def __repr__(self) -> str:
        state = ", ".join(f"{n} {s.missed} missed" for n, s in self._streams.items()) or "closed"
        return f"<SetReader of rig {self.rig!r}: {state}>"
