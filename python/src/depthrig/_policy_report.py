"""Counts and times of a policy loop."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

# Of each time the newest are kept: an hour at 30 Hz.
KEPT_TIMES = 108_000


@dataclass(frozen=True)
class Spread:
    """Distribution of a time, milliseconds."""

    p50_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: deque[float]) -> Spread | None:
        """Return that of measured seconds; None without any."""
        if not seconds:
            return None
        p50, p99, largest = np.percentile(np.array(seconds) * 1e3, (50, 99, 100))
        return cls(float(p50), float(p99), float(largest))


@dataclass(frozen=True)
class Report:
    """What a :class:`depthrig.policy.PolicyLoop` did. `print(report)` is a table; :meth:`to_json` is for programs."""

    observations: int
    """Calls of the policy."""
    actions: int
    """Actions that it returned."""
    late: int
    """Actions that came after the end of their period; counted with `hz`."""
    stale: int
    """Steps without a policy call because the newest images were older than `max_age`."""
    skipped: int
    """Images of the first stream between two that were observed."""
    incomplete: int
    """Sets of a replay that lacked a declared stream."""
    no_sample: Mapping[str, int]
    """For each signal the steps without a policy call because it had no value at the time of the images."""
    missed: Mapping[str, int]
    """For each stream and each signal what was replaced before the loop read it."""
    seconds: float
    """Since the first observation."""
    is_replay: bool
    """Whether the rig is a replay: its images have no age."""
    assembly: Spread | None
    """Reading the images and the samples into an observation, without waiting for either."""
    age: Spread | None
    """Exposure of the oldest image to the call of the policy; None for a replay."""
    policy: Spread | None
    """The policy's own time."""
    age_at_action: Spread | None
    """Exposure of the oldest image to the published action; None for a replay."""
    jitter: Spread | None
    """How far the time between two calls is from the period, or from its median without `hz`; None for a replay."""

    def to_json(self) -> str:
        """Return it as a JSON object; times are milliseconds."""
        return json.dumps(asdict(self), indent=2)

    def __str__(self) -> str:
        counts = {
            name: getattr(self, name) for name in ("observations", "actions", "late", "stale", "skipped", "incomplete")
        }
        counts |= {f"no sample of {name}": count for name, count in self.no_sample.items() if count}
        counts |= {f"missed of {name}": count for name, count in self.missed.items() if count}
        lines = [", ".join(f"{name} {count}" for name, count in counts.items()) + f" in {self.seconds:.1f} s"]
        explained = {
            "assembly": "images and samples to an observation",
            "age": "exposure to the policy's input",
            "policy": "the policy",
            "age_at_action": "exposure to the action",
            "jitter": "time between calls, off its period",
        }
        lines.append(f"{'milliseconds':<15}{'p50':>9}{'p99':>9}{'max':>9}")
        for name, text in explained.items():
            spread: Spread | None = getattr(self, name)
            if spread is not None:
                lines.append(f"{name:<15}{spread.p50_ms:>9.2f}{spread.p99_ms:>9.2f}{spread.max_ms:>9.2f}   {text}")
        return "\n".join(lines)


class Times:
    """The times of a loop while it runs, seconds."""

    def __init__(self) -> None:
        self.assembly: deque[float] = deque(maxlen=KEPT_TIMES)
        self.age: deque[float] = deque(maxlen=KEPT_TIMES)
        self.policy: deque[float] = deque(maxlen=KEPT_TIMES)
        self.age_at_action: deque[float] = deque(maxlen=KEPT_TIMES)
        self.starts: deque[float] = deque(maxlen=KEPT_TIMES)

    def jitter(self, period: float | None) -> deque[float]:
        """Return how far each time between two calls is from the period, or from their median."""
        between = np.diff(np.array(self.starts))
        if not len(between):
            return deque()
        return deque(np.abs(between - (np.median(between) if period is None else period)).tolist())
