"""Runs a command for every part of its work: `python -m depthrig.lab.ray N -- COMMAND…` appends `--shard K/N`.

With the package `ray` the parts run on its cluster, one CPU each; with `--local JOBS` they run here. A command must
be free of state: run again, it leaves what is complete and makes the rest. A part whose command fails, or whose
worker dies, is run again; a command ends with its worker, so that the next one finds no other at its work.
"""

from __future__ import annotations

import argparse
import ctypes
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from typing import Any

from .errors import LabError
from .progress import bar

__all__ = ["main", "run_local", "run_ray"]

RETRIES = 2
_PR_SET_PDEATHSIG = 1  # prctl(2)
_prctl = ctypes.CDLL(None).prctl


class PartFailedError(Exception):
    """A command that ended with another code than 0."""


def _end_with_worker() -> None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _part(command: Sequence[str], k: int, n: int) -> None:
    part = [*command, "--shard", f"{k}/{n}"]
    done = subprocess.run(part, capture_output=True, text=True, check=False, preexec_fn=_end_with_worker)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise PartFailedError(f"--shard {k}/{n} ended with {done.returncode}: {lines[-1] if lines else 'no message'}")


def run_local(command: Sequence[str], n: int, jobs: int, retries: int = RETRIES) -> None:
    """Run all parts here, `jobs` at once.

    :raises LabError: when a part failed `retries` + 1 times; the others were run.
    """

    def attempt(k: int) -> str:
        for left in range(retries, -1, -1):
            try:
                _part(command, k, n)
                return ""
            except (PartFailedError, OSError) as e:
                if left == 0:
                    return str(e)
        return ""

    failed = []
    with ThreadPoolExecutor(jobs) as pool, closing(bar(n, "part")) as progress:
        for ended in as_completed([pool.submit(attempt, k) for k in range(n)]):
            progress.update()
            failed += [ended.result()] if ended.result() else []
    _report(failed, n)


def run_ray(command: Sequence[str], n: int, address: str | None = None, retries: int = RETRIES) -> None:
    """Run all parts on a Ray cluster, one CPU each.

    :param address: of the cluster; one on this computer is started without it.
    :raises LabError: when Ray is not installed, or a part failed `retries` + 1 times; the others were run.
    """
    try:
        import ray
    except ImportError as e:
        raise LabError("the package ray is not installed: pip install ray, or use --local JOBS") from e
    ray.init(address=address, include_dashboard=False, log_to_driver=False)
    try:
        task: Any = ray.remote(num_cpus=1, max_retries=retries, retry_exceptions=True)(_part)
        failed = []
        running = [task.remote(list(command), k, n) for k in range(n)]
        with closing(bar(n, "part")) as progress:
            while running:
                (ended,), running = ray.wait(running)
                try:
                    ray.get(ended)
                except ray.exceptions.RayError as e:
                    failed.append(str(e).strip().splitlines()[-1])
                progress.update()
    finally:
        ray.shutdown()
    _report(failed, n)


def _report(failed: list[str], n: int) -> None:
    if failed:
        raise LabError(f"{len(failed)} of {n} parts failed; the first: {failed[0]}; run it again for the rest")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns 0, or 1 with a message."""
    parser = argparse.ArgumentParser(
        prog="python -m depthrig.lab.ray", description="Run a command once per part, with --shard K/N appended"
    )
    parser.add_argument("parts", metavar="N", type=int, help="number of parts")
    parser.add_argument("command", metavar="COMMAND", nargs="+", help="after --: the command of one part")
    parser.add_argument("--local", metavar="JOBS", type=int, help="run here, so many at once, without Ray")
    parser.add_argument("--address", help="address of a Ray cluster [default: one is started here]")
    parsed = parser.parse_args(arguments)
    try:
        if parsed.parts < 1 or (parsed.local is not None and parsed.local < 1):
            raise LabError("N and JOBS are at least 1")
        if parsed.local is not None:
            run_local(parsed.command, parsed.parts, parsed.local)
        else:
            run_ray(parsed.command, parsed.parts, parsed.address)
    except LabError as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
