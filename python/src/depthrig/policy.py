"""A policy in closed loop: images and signals at one time, actions that are recorded, and where the time goes.

>>> from depthrig.policy import PolicyLoop
>>> def policy(seen):
...     return [0.0] * 7 if seen["wrist"].any() else None
>>> images = {"wrist": "d405/depth_refined", "front": "d435/color"}
>>> action = depthrig.Signal("policy/action", [f"joint_{i}" for i in range(7)], unit="rad", kind="joints")
>>> with PolicyLoop(images, {"joints": "arm/joint_position"}, action=action, max_gap=0.02) as loop:
...     print(loop.run(policy, seconds=60))
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Union

import numpy.typing as npt

from ._frame import Frame
from ._group import FrameGroup, SetReader
from ._policy_images import ReplayedImages, open_images
from ._policy_report import Report, Spread, Times
from ._reader import SLICE_S
from ._runtime import PathLike
from ._sets import Sets
from ._signal import Signal
from ._signal_reader import SignalReader
from ._signal_sample import SignalSample
from .errors import SignalGap, SignalOutside, Stale, StreamGone, StreamNotFound

__all__ = ["Action", "Observation", "PolicyLoop", "Report", "Spread"]

Action = Union[Sequence[Any], "npt.NDArray[Any]", Mapping[str, Any]]
"""What a policy returns: the values of the loop's action signal, as :meth:`depthrig.Signal.publish` takes them."""


@dataclass(frozen=True)
class Observation:
    """Images and signals at one time. `observation["wrist"]` is an image's array or a signal's values.

    Images are views of shared memory. Their frames are released when the policy returns, or with `hz` when newer ones are
    there; an array that is kept holds its slot, so keep copies.
    """

    number: int
    """1, 2, 3, …"""
    time_ns: int
    """Capture time of the first declared image; signals have their values at this time."""
    frames: Mapping[str, Frame]
    """The frame of each image."""
    signals: Mapping[str, SignalSample]
    """The sample of each signal, interpolated to `time_ns`."""
    is_new: bool
    """Whether the images are others than those of the observation before."""

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return the pixels of an image, a read-only array without a copy, or the values of a signal of one type."""
        frame = self.frames.get(name)
        return self.signals[name].values if frame is None else frame.array

    @property
    def age_s(self) -> float:
        """Seconds since the exposure of the oldest image. Of a replay it is the age of the recording."""
        return max(frame.age_s for frame in self.frames.values())

    @property
    def replayed(self) -> bool:
        """Whether it comes from a replay."""
        return any(frame.replayed for frame in self.frames.values())


class PolicyLoop:
    """Calls a policy with observations of a rig, and publishes what it returns.

    `images` are names of your choice and their streams, `signals` names and signals. The frames of an observation are at
    most `max_skew` seconds apart, and each signal has its value at the capture time of the first image: between two
    samples at most `max_gap` seconds apart (a number, or one for each name). The sample after that time is waited for up to
    `wait` seconds. Nothing is extrapolated: without a value there is no observation, which the report counts.

    With `hz` the policy is called at that rate with the newest images; without it once for each new image of all streams. On
    images older than `max_age` seconds it is not called. What it returns, unless None, is published on `action`.

    Of a replay each set is observed once, in order, and the same dataset gives the same observations, as
    :mod:`depthrig._policy_images` explains. Then `wait` and `hz` count in the time of the recording, and images have no age.

    Raises what :class:`depthrig.Stream` and :class:`depthrig.SignalReader` raise when one cannot be opened within
    `timeout` seconds. A loop belongs to one thread.
    """

    def __init__(
        self,
        images: Mapping[str, str],
        signals: Mapping[str, str] | None = None,
        *,
        action: Signal | None = None,
        hz: float | None = None,
        max_age: float = 0.5,
        max_skew: float = 0.05,
        max_gap: float | Mapping[str, float] = 0.1,
        wait: float = 0.05,
        rig: str | None = None,
        runtime_dir: PathLike | None = None,
        timeout: float = 2.0,
    ) -> None:
        self._reader: SetReader | None = None
        self._sets: Sets | None = None
        self._signals: dict[str, SignalReader] = {}
        signals = signals or {}
        if not images:
            raise ValueError("images is empty; a policy loop observes at least one stream")
        if both := sorted(set(images) & set(signals)):
            raise ValueError(f"{', '.join(both)} names an image and a signal; give them different names")
        if hz is not None and not hz > 0:
            raise ValueError(f"hz is a number of calls a second above 0, not {hz!r}")
        if not max_age > 0:
            raise ValueError(f"max_age is a number of seconds above 0, not {max_age!r}")
        gaps = dict(max_gap) if isinstance(max_gap, Mapping) else dict.fromkeys(signals, max_gap)
        if unlike := sorted(set(gaps) ^ set(signals)):
            raise ValueError(f"max_gap: {', '.join(unlike)} is no signal of this loop or has no gap")
        self._names = dict(images)
        self._gaps = gaps
        self._action = action
        self._period = None if hz is None else 1 / hz
        self._max_age = max_age
        self._wait_s = wait
        self._images: SetReader | ReplayedImages | None = None
        self._held: FrameGroup | None = None
        self._due: float | None = None
        self._due_ns: int | None = None
        self._last_sequence: int | None = None
        self._began: float | None = None
        self._times = Times()
        self._counts = dict.fromkeys(("observations", "actions", "late", "stale", "skipped", "incomplete"), 0)
        self._no_sample = dict.fromkeys(signals, 0)
        self._assembling = 0.0
        try:
            streams = dict.fromkeys(images.values())
            self._reader = SetReader(streams, rig, runtime_dir, timeout, max_skew=max_skew)
            try:
                self._sets = Sets(self._reader.rig, runtime_dir, timeout)
            except StreamNotFound:
                pass  # a publisher of streams alone
            for name, signal in signals.items():
                self._signals[name] = SignalReader(signal, runtime_dir, timeout)
        except BaseException:
            self.close()
            raise

    def run(
        self, policy: Callable[[Observation], Action | None], seconds: float | None = None, steps: int | None = None
    ) -> Report:
        """Call `policy` for so many seconds or observations, whichever comes first, and return the report.

        Ends with a replay; raises StreamGone when a live rig ends.
        """
        deadline = float("inf") if seconds is None else time.monotonic() + seconds
        done = 0
        while time.monotonic() < deadline and (steps is None or done < steps):
            try:
                done += self.step(policy)
            except StreamGone:
                if isinstance(self._images, ReplayedImages):
                    break
                raise
        return self.report()

    def step(self, policy: Callable[[Observation], Action | None]) -> bool:
        """Wait for an observation, call the policy, publish its action; return whether the policy was called.

        False is counted as stale, incomplete or without a sample in the report, or nothing came within `max_age`.
        Raises StreamGone when the rig or the replay has ended.
        """
        seen = self.observe()
        if seen is None:
            return False
        try:
            began = time.monotonic()
            self._times.starts.append(began)
            if not seen.replayed:
                self._times.age.append(seen.age_s)
            values = policy(seen)
            self._times.policy.append(time.monotonic() - began)
            if values is not None:
                self._counts["actions"] += 1
                if self._action is not None:
                    self._action.publish(values)
                if not seen.replayed:
                    self._times.age_at_action.append(seen.age_s)
        finally:
            if self._period is None or seen.replayed:
                for frame in seen.frames.values():
                    frame.release()
        if self._due is not None and time.monotonic() > self._due:
            self._counts["late"] += 1
        return True

    def observe(self) -> Observation | None:
        """Wait for an observation as :meth:`step` does, for a loop of your own; None when there is none to act on."""
        if self._reader is None:
            raise ValueError("the loop was closed")
        if self._images is None:
            self._images = open_images(self._reader, self._sets, self._max_age)
            if self._images is None:
                self._counts["stale"] += 1
                return None
        if isinstance(self._images, ReplayedImages):
            return self._observe_set(self._images)
        return self._observe_newest(self._images)

    def _observe_newest(self, reader: SetReader) -> Observation | None:
        self._sleep()
        began = time.perf_counter()
        group = reader.latest()
        if group is None or group.age_s > self._max_age:
            try:
                is_kept = self._held is not None and self._held.age_s <= self._max_age
                group = reader.wait_fresh(self._max_age, 0.0 if is_kept else None)
            except Stale:
                group = self._held if is_kept else None
            began = time.perf_counter()
        if group is None:
            self._held = None
            self._counts["stale"] += 1
            return None
        is_new = group is not self._held
        self._held = group if self._period is not None else None
        frames = {name: group[stream] for name, stream in self._names.items()}
        time_ns = next(iter(frames.values())).capture_time_ns
        self._assembling = time.perf_counter() - began
        samples: dict[str, SignalSample] = {}
        deadline = time.monotonic() + self._wait_s
        for name, signal in self._signals.items():
            sample = self._live_sample(name, signal, time_ns, deadline)
            if sample is None:
                return None
            samples[name] = sample
        return self._observation(frames, samples, time_ns, is_new)

    def _observe_set(self, images: ReplayedImages) -> Observation | None:
        replayed = images.next(self._take_samples, self._max_age)
        if replayed is None:
            return None
        if self._period is not None:
            if self._due_ns is not None and replayed.tick_ns < self._due_ns:
                return None
            self._due_ns = replayed.tick_ns + int(self._period * 1e9)
        began = time.perf_counter()
        if replayed.group is None:
            self._counts["incomplete"] += 1
            return None
        frames = {name: replayed.group[stream] for name, stream in self._names.items()}
        time_ns = next(iter(frames.values())).capture_time_ns
        until_ns = time_ns + int(self._wait_s * 1e9)
        if replayed.next_tick_ns is not None:
            until_ns = min(until_ns, replayed.next_tick_ns)
        samples = {}
        for name, signal in self._signals.items():
            after = signal._after(time_ns)
            sample = self._sample(name, signal, time_ns) if after is not None and after <= until_ns else None
            if sample is None:
                self._no_sample[name] += 1
                return None
            samples[name] = sample
        self._assembling = time.perf_counter() - began
        return self._observation(frames, samples, time_ns, True)

    def _observation(
        self, frames: dict[str, Frame], samples: dict[str, SignalSample], time_ns: int, is_new: bool
    ) -> Observation:
        self._times.assembly.append(self._assembling)
        sequence = next(iter(frames.values())).sequence
        if self._last_sequence is not None:
            self._counts["skipped"] += max(0, sequence - self._last_sequence - 1)
        self._last_sequence = sequence
        self._counts["observations"] += 1
        if self._began is None:
            self._began = time.monotonic()
        return Observation(self._counts["observations"], time_ns, frames, samples, is_new)

    def _live_sample(self, name: str, signal: SignalReader, time_ns: int, deadline: float) -> SignalSample | None:
        """Return the value at a time, waiting for the sample after it."""
        while True:
            began = time.perf_counter()
            sample = self._sample(name, signal, time_ns)
            self._assembling += time.perf_counter() - began
            left = deadline - time.monotonic()
            # After a gap, or before the first sample that is kept, waiting does not help.
            if sample is not None or left <= 0 or signal._after(time_ns) is not None:
                break
            signal._open.wait(min(SLICE_S, left))
        if sample is None:
            self._no_sample[name] += 1
        return sample

    def _sample(self, name: str, signal: SignalReader, time_ns: int) -> SignalSample | None:
        try:
            return signal.at(time_ns, self._gaps[name])
        except (SignalGap, SignalOutside):
            return None

    def _take_samples(self) -> None:
        for signal in self._signals.values():
            signal._fill()

    def _sleep(self) -> None:
        """Sleep until the next call is due. Delays are not made up by a burst."""
        if self._period is None:
            return
        now = time.monotonic()
        if self._due is not None and self._due > now:
            time.sleep(self._due - now)
            now = self._due
        self._due = now + self._period

    def report(self) -> Report:
        """Return what the loop has done so far."""
        missed = {} if self._reader is None else dict(self._reader.missed)
        missed |= {signal.name: signal.missed for signal in self._signals.values()}
        is_replay = isinstance(self._images, ReplayedImages)
        times = self._times
        return Report(
            **self._counts,
            no_sample=dict(self._no_sample),
            missed=missed,
            seconds=0.0 if self._began is None else time.monotonic() - self._began,
            is_replay=is_replay,
            assembly=Spread.of(times.assembly),
            age=Spread.of(times.age),
            policy=Spread.of(times.policy),
            age_at_action=Spread.of(times.age_at_action),
            jitter=None if is_replay else Spread.of(times.jitter(self._period)),
        )

    def close(self) -> None:
        """Stop reading. The action signal stays open: it is yours."""
        self._held = None
        for reader in (self._reader, self._sets, *self._signals.values()):
            if reader is not None:
                reader.close()

    def __enter__(self) -> PolicyLoop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
