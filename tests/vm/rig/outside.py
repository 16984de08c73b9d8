"""Datasets that scenarios brought out of the guest, read on the host by programs that are not ours."""

import subprocess
from pathlib import Path

from .programs import ROOT

READER = ROOT / "tests/readers/check_open.py"
# The environment with those programs; `make` makes it.
PYTHON = ROOT / ".venv/bin/python"
LIMIT_S = 600


def read(report, share: Path, required: bool):
    """Has what is below `share`/out read: a folder for each scenario, with a `dataset` and `expected.json`. What each reader
    says becomes a check of that scenario in `report`."""
    for folder in sorted((share / "out").glob("*")):

        def check(name: str, holds: bool, detail: str, scenario=folder.name):
            report.entry({"scenario": scenario, "kind": "check", "check": name, "holds": holds, "detail": detail})

        if not PYTHON.exists():
            lacks = f"{PYTHON.relative_to(ROOT)} is not there; make {PYTHON.parents[1].name}/.stamp makes it"
            if required:
                check("the dataset is read on the host by others", False, lacks)
            else:
                report.entry({"scenario": folder.name, "kind": "note", "text": f"not read by others: {lacks}"})
            continue
        command = [PYTHON, READER, folder / "dataset", folder / "expected.json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
        lines = [line for line in done.stdout.splitlines() if line[:5] in ("ok   ", "FAIL ")]
        for line in lines:
            reader, _, found = line[5:].partition(": ")
            check(f"read on the host by {reader}", line.startswith("ok"), found)
        if not lines or done.returncode not in (0, 1):
            check("the dataset is read on the host by others", False, done.stderr.strip()[-500:])
