"""Reads the guest's report as it grows, and prints one line for each check."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Outcome:
    """What is known of one scenario."""

    started: bool = False
    ended: bool = False
    passed: int = 0
    failed: int = 0
    guest_s: float = 0.0
    cpu_s: float = 0.0
    failures: list[str] = field(default_factory=list)


class Report:
    """The report of one boot. The guest appends one JSON object for each line."""

    def __init__(self, path: Path, scenarios: list[str], say, used_s: Callable[[], float]):
        self.path = path
        self.used_s = used_s  # the processor time of QEMU so far
        self.outcomes = {name: Outcome() for name in scenarios}
        self.say = say
        self.read = 0

    def follow(self):
        """Prints what has been added since."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self.read)
            new = file.read()
        whole = new[: new.rfind(b"\n") + 1]
        self.read += len(whole)
        for line in whole.splitlines():
            self.entry(json.loads(line))

    def entry(self, entry: dict):
        outcome = self.outcomes[entry["scenario"]]
        match entry["kind"]:
            case "start":
                outcome.started = True
                outcome.cpu_s = -self.used_s()
            case "check":
                detail = f" ({entry['detail']})" if entry["detail"] else ""
                line = f"{entry['scenario']}: {entry['check']}{detail}"
                if entry["holds"]:
                    outcome.passed += 1
                else:
                    outcome.failed += 1
                    outcome.failures.append(line)
                self.say(f"{'ok  ' if entry['holds'] else 'FAIL'} {line}")
            case "note":
                self.say(f"     {entry['scenario']}: {entry['text']}")
            case "end":
                outcome.ended = True
                outcome.guest_s = entry["guest_s"]
                outcome.cpu_s += self.used_s()
                took = f"{entry['guest_s']:.1f} s of guest time, {outcome.cpu_s:.0f} s of QEMU's"
                self.say(f"  -- {entry['scenario']}: {took}")
