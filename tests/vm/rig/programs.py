"""The programs under test, built as `make test` builds them, and the list of scenarios."""

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

from . import Broken

ROOT = Path(__file__).parents[3]
# Those of the wanted programs that are examples.
EXAMPLES = ("external",)


@dataclass(frozen=True)
class Scenario:
    """What `guest list` says of one."""

    name: str
    about: str
    cost: int  # processor seconds of the host, roughly
    needs: str  # an archive beside those of every boot; empty: none


def build(wanted: list[str]) -> list[Path]:
    """Builds the programs and returns their paths. The selection of packages is that of tools/test.sh, so that nothing
    is compiled a second time with other features."""
    command = ["cargo", "build", "--quiet", "--workspace"]
    for program in wanted:
        command += ["--example" if program in EXAMPLES else "--bin", program]
    if subprocess.run(command, cwd=ROOT).returncode:
        raise Broken("the programs under test do not build")
    return built(wanted)


def built(wanted: list[str]) -> list[Path]:
    """The paths of programs that have been built."""
    folder = Path(os.environ.get("CARGO_TARGET_DIR") or ROOT / "target") / "debug"
    paths = [folder / "examples" / program if program in EXAMPLES else folder / program for program in wanted]
    missing = [path.name for path in paths if not path.exists()]
    if missing:
        raise Broken(f"{', '.join(missing)}: not in {folder}")
    return paths


def scenarios(guest: Path) -> list[Scenario]:
    """Every scenario that the guest's program knows."""
    listed = subprocess.run([guest, "list", "--json"], capture_output=True, text=True)
    if listed.returncode:
        raise Broken(f"guest list: {listed.stderr.strip()}")
    return [Scenario(**entry) for entry in json.loads(listed.stdout)]
