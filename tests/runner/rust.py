#!/usr/bin/env python3
"""Runs test executables that cargo has built, each in a box (box.py), and counts their results.

    cargo test --workspace --no-run --message-format=json >MESSAGES
    tests/runner/rust.py MESSAGES [--only CRATE[:TARGET][=FILTER]]... [--without CRATE:TARGET]... [--shm MIB] [--nofile N] [--busy N] [--jobs N]

A test that has not ended `DEPTHRIG_TEST_LIMIT_S` seconds (600) after the one before it is killed with all that it
started, and named. A test that says "skipped: why" and passes is counted as skipped, and so is one that fails because it
does not find the real images, which its message says (`DEPTHRIG_TEST_DATA`), where tools/test.sh has found that these are
missing and may be (`DEPTHRIG_DATA_MISSING`). Names of skipped tests go to stdout and to the file of `DEPTHRIG_TEST_SKIPS`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import takewhile
from multiprocessing import get_context
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).resolve().parent))
from box import TIMED_OUT, Box  # noqa: E402

LIMIT_S = float(os.environ.get("DEPTHRIG_TEST_LIMIT_S", "600"))
NEEDS_MOUNTS = {("depthrig-tests", "storage_faults"), ("depthrig-tests", "replay")}
"""Executables with tests that mount a small disk."""
MISSING_DATA = "DEPTHRIG_DATA_MISSING" in os.environ
"""The real images may be missing (tools/test.sh)."""
RESULT = re.compile(r"^test (?P<name>.+?) \.\.\. (?P<result>ok|FAILED|ignored.*)$")
ENDED = re.compile(r"^test result: .* (?P<filtered>\d+) filtered out")
OUTPUT = re.compile(r"^---- (?P<name>.+?) stdout ----$")
SKIPPED = re.compile(r"^\s*skipped: ", re.IGNORECASE)
PANICKED = re.compile(r"^thread .* panicked at (?P<place>.+):\d+:$")


@dataclass
class Executable:
    """A test executable as cargo describes it."""

    crate: str
    target: str
    kind: str
    path: str
    folder: Path

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.crate} {self.kind} {self.target}"

    def environment(self, programs: dict[str, str]) -> dict[str, str]:
        """The environment that cargo would have set."""
        env = dict(os.environ)
        env["CARGO_MANIFEST_DIR"] = str(self.folder)
        env["CARGO_MANIFEST_PATH"] = str(self.folder / "Cargo.toml")
        env["CARGO_PKG_NAME"] = self.crate
        return env | programs


@dataclass
class Outcome:
    """The results in an executable's output."""

    results: dict[str, str] = field(default_factory=dict)
    output: dict[str, list[str]] = field(default_factory=dict)
    stray: list[str] = field(default_factory=list)
    """Lines outside any test's captured output."""
    ended: bool = False
    _inside: str | None = None

    def take(self, line: str) -> bool:
        """Takes a line of output; returns whether it is a sign of progress."""
        if found := RESULT.match(line):
            self.results[found["name"]] = found["result"]
            return True
        if found := OUTPUT.match(line):
            self._inside = found["name"]
            self.output[self._inside] = []
        elif ENDED.match(line):
            self.ended = True
        elif line in ("successes:", "failures:"):
            self._inside = None
        elif self._inside is not None:
            self.output[self._inside].append(line)
        elif line and not re.match(r"^(running \d+ tests?$|    \S)", line):
            self.stray.append(line)
        return False


@dataclass
class Totals:
    """Results of an executable."""

    failed: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


def read_messages(path: Path) -> tuple[list[Executable], dict[str, str]]:
    """The test executables, and the environment that names the programs beside them."""
    executables, programs = [], {}
    for line in path.read_text().splitlines():
        if not line.startswith("{"):
            continue
        message = json.loads(line)
        if message.get("reason") != "compiler-artifact" or not message.get("executable"):
            continue
        target = message["target"]
        if message["profile"]["test"]:
            manifest = Path(message["manifest_path"])
            crate = message["package_id"].rpartition("#")[2].partition("@")[0]
            if crate[:1].isdigit():
                crate = manifest.parent.name
            kind = target["kind"][0]
            executables.append(Executable(crate, target["name"], kind, message["executable"], manifest.parent))
        elif target["kind"] == ["bin"]:
            programs[f"CARGO_BIN_EXE_{target['name']}"] = message["executable"]
    return sorted(executables, key=lambda e: (e.crate, e.kind, e.target)), programs


def names_of(executable: Executable, box: Box, filters: list[str], env: dict[str, str]) -> list[str]:
    """The tests of an executable."""
    lines: list[str] = []
    argv = [executable.path, "--list", "--format=terse", *filters]
    box.run(argv, limit_s=60, cwd=executable.folder, env=env, line=lambda line: lines.append(line) is None)
    return [line.removesuffix(": test") for line in lines if line.endswith(": test")]


def run(executable: Executable, box: Box, filters: list[str], programs: dict[str, str]) -> tuple[str, Totals]:
    """Runs an executable; returns what there is to print of it, and its counts."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        totals = results_of(executable, box, filters, programs)
    return printed.getvalue(), totals


def results_of(executable: Executable, box: Box, filters: list[str], programs: dict[str, str]) -> Totals:
    """Runs an executable and prints its results."""
    env = executable.environment(programs)
    box.mounts = (executable.crate, executable.target) in NEEDS_MOUNTS
    outcome = Outcome()
    started = time.monotonic()
    argv = [executable.path, "--show-output", "--color=never", *filters]
    status = box.run(argv, idle_s=LIMIT_S, cwd=executable.folder, env=env, line=outcome.take)
    skipped, failed = [], []
    for name, result in outcome.results.items():
        text = outcome.output.get(name, [])
        if result == "FAILED" and MISSING_DATA and any("DEPTHRIG_TEST_DATA" in line for line in text):
            skipped.append((name, "no real images"))
        elif result == "FAILED":
            failed.append(name)
        elif result == "ok" and (why := next((line for line in text if SKIPPED.match(line)), None)):
            skipped.append((name, why.strip().partition(" ")[2]))
    passed = sum(result == "ok" for result in outcome.results.values()) - sum(
        outcome.results[name] == "ok" for name, _ in skipped
    )
    ignored = sum(result.startswith("ignored") for result in outcome.results.values())
    if not outcome.ended:
        # It was killed, or died; tests without a result were running, or never began.
        unfinished = [name for name in names_of(executable, box, filters, env) if name not in outcome.results]
        why = f"killed after {LIMIT_S:.0f} s without a result" if status == TIMED_OUT else f"died with status {status}"
        print(f"{executable.name}: {why}; without a result: {', '.join(unfinished) or 'none'}")
        print("\n".join(outcome.stray[-40:]))
        failed += unfinished or [f"{executable.target} itself"]
    for name in failed:
        print(f"---- {executable.crate} {name}\n" + "\n".join(outcome.output.get(name, [])))
    word = "FAILED" if failed else "ok"
    took = time.monotonic() - started
    line = f"test result: {word}. {passed} passed; {len(failed)} failed; {ignored} ignored; {len(skipped)} skipped"
    print(f"{line}; {took:.1f} s: {executable.name}", flush=True)
    return Totals(
        [f"{executable.crate} {name} - {reason(outcome.output.get(name, []))}" for name in failed],
        [f"{executable.crate} {name}: {why}" for name, why in skipped],
    )


def reason(output: list[str]) -> str:
    """The place of a test's first panic, and the first lines of its message."""
    for at, line in enumerate(output):
        if found := PANICKED.match(line):
            message = takewhile(lambda line: not line.startswith(("stack backtrace:", "note: ")), output[at + 1 : at + 4])
            return f"{found['place']}: " + " ".join(line.strip() for line in message)
    return "no panic in its output"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("messages", type=Path)
    parser.add_argument("--only", action="append", metavar="CRATE[:TARGET][=FILTER]", help="run these alone")
    parser.add_argument("--without", action="append", default=[], metavar="CRATE:TARGET", help="leave out executables")
    parser.add_argument("--skip", action="append", default=[], metavar="TEST", help="leave out tests of this name")
    parser.add_argument("--shm", type=int, metavar="MIB", help="size of /dev/shm")
    parser.add_argument("--nofile", type=int, metavar="N", help="most descriptors of a process")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy loops beside each executable")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="executables at once; most tests wait")
    args = parser.parse_args()
    executables, programs = read_messages(args.messages)
    executables = [e for e in executables if f"{e.crate}:{e.target}" not in args.without]
    wanted: list[tuple[Executable, list[str]]] = []
    skips = [word for name in args.skip for word in ("--skip", name)]
    for only in args.only or [""]:
        selector, _, name = only.partition("=")
        crate, _, target = selector.partition(":")
        found = [e for e in executables if crate in ("", e.crate) and target in ("", e.target)]
        if not found:
            print(f"no test executable is {only}", file=sys.stderr)
            return 1
        wanted += [(e, ([name] if name else []) + skips) for e in found]
    box = Box(shm_mib=args.shm, nofile=args.nofile, busy=args.busy)
    failures: list[str] = []
    failed: list[str] = []
    skipped: list[str] = []
    # Processes, not threads: a box kills all descendants of its process.
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("fork")) as pool:
        running = [(e, pool.submit(run, e, box, filters, programs)) for e, filters in wanted]
        for executable, ended in running:
            text, totals = ended.result()
            print(text, end="", flush=True)
            skipped += totals.skipped
            failed += totals.failed
            if totals.failed:
                failures.append(executable.name)
    for line in skipped:
        print(f"skipped {line}")
    if (path := os.environ.get("DEPTHRIG_TEST_SKIPS")) and skipped:
        with open(path, "a") as file:
            file.writelines(f"{line}\n" for line in skipped)
    for line in failed:
        # As pytest has it: tools/test.sh shows these lines once more at its end.
        print(f"FAILED {line}")
    if failures:
        print(f"failed: {', '.join(failures)}")
    return 1 if failures or not wanted else 0


if __name__ == "__main__":
    sys.exit(main())
