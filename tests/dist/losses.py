"""Holds a recording to its account: a busy computer may lose sets, each counted, and no more than half of them.

losses.py PROGRAM DATASET
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

COMPLETE, LOST = 0, 3
"""Exit codes of `depthrig verify` for an intact dataset."""


def main(program: str, dataset: str) -> None:
    """Compares the dataset, as `verify` finds it, with the outcome in its session."""
    done = subprocess.run([program, "verify", "--decode", "--json", dataset], capture_output=True, text=True, check=False)
    if done.returncode not in (COMPLETE, LOST):
        raise SystemExit(f"verify ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    found = json.loads(done.stdout)["sets"]
    outcome = tomllib.loads(Path(dataset, "session.toml").read_text())["outcome"]
    lost = outcome.get("sets_dropped", {})
    dropped = sum(lost.values())
    print(f"verified: {found} sets of {outcome['sets_offered']}, lost {lost or 'none'}")
    if found != outcome["sets_recorded"] or found + dropped != outcome["sets_offered"]:
        raise SystemExit(f"{found} sets are in the dataset; its outcome is {outcome}")
    if dropped and (done.returncode != LOST or outcome["complete"]):
        raise SystemExit(f"sets were lost, and verify ended with {done.returncode}; the outcome is {outcome}")
    if not found or dropped > found:
        raise SystemExit("more than half of the sets were lost")


if __name__ == "__main__":
    main(*sys.argv[1:])
