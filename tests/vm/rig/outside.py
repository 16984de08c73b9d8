"""Datasets that scenarios brought out of the guest, read on the host by programs that are not ours."""

import subprocess
from pathlib import Path

from .programs import ROOT

READER = ROOT / "tests/readers/check_open.py"
# The environment with those programs; `make` makes it.
PYTHON = ROOT / ".venv/bin/python"
LIMIT_S = 600


class Reading:
    """Has what one boot brings out read: a folder for each scenario below `share`/out, with a `dataset` and `expected.json`,
    as soon as that scenario has ended, while the others go on. What each reader says becomes a check of the scenario."""

    def __init__(self, report, share: Path, required: bool):
        self.report, self.share, self.required = report, share, required
        self.running: dict[str, subprocess.Popen] = {}

    def begin(self, last: bool = False):
        """Starts the readers of what is there and not read yet; `last`: whether or not its scenario came to its end."""
        for folder in sorted((self.share / "out").glob("*/")):
            name = folder.name
            if name in self.running or not (last or self.report.outcomes[name].ended) or not PYTHON.exists():
                continue
            command = [PYTHON, READER, folder / "dataset", folder / "expected.json"]
            with (self.share / f"{name}.read").open("wb") as said:
                self.running[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT)

    def end(self):
        """Waits for the readers and reports what they found."""
        if not PYTHON.exists():
            for folder in sorted((self.share / "out").glob("*/")):
                self.lacking(folder.name)
        self.begin(last=True)
        for name, process in self.running.items():
            try:
                status = process.wait(LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                status = process.wait()
            text = (self.share / f"{name}.read").read_text(errors="replace")
            lines = [line for line in text.splitlines() if line[:5] in ("ok   ", "FAIL ")]
            for line in lines:
                reader, _, found = line[5:].partition(": ")
                self.check(name, f"read on the host by {reader}", line.startswith("ok"), found)
            if not lines or status not in (0, 1):
                self.check(name, "the dataset is read on the host by others", False, text.strip()[-500:])

    def stop(self):
        """Ends them at once."""
        for process in self.running.values():
            process.kill()
            process.wait()

    def lacking(self, name: str):
        lacks = f"{PYTHON.relative_to(ROOT)} is not there; make {PYTHON.parents[1].name}/.stamp makes it"
        if self.required:
            self.check(name, "the dataset is read on the host by others", False, lacks)
        else:
            self.report.entry({"scenario": name, "kind": "note", "text": f"not read by others: {lacks}"})

    def check(self, scenario: str, name: str, holds: bool, detail: str):
        self.report.entry({"scenario": scenario, "kind": "check", "check": name, "holds": holds, "detail": detail})
