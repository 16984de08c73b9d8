#!/usr/bin/env python3
"""Runs a command in a box: as an ordinary user, with a time limit, default signals and, on request, small limits.

    tests/runner/box.py [--limit S] [--as-root] [--mounts] [--shm MIB] [--nofile N] [--busy N] -- COMMAND...

Started by root it runs the command as the user of `DEPTHRIG_TEST_USER` (`UID:GID:HOME`, from tools/test.sh), in a mount
namespace in which that user can enter the folders of `DEPTHRIG_TEST_OPEN` (separated by colons) even where they lie below
one that only root can enter. Started by anybody else it runs it as that user.

The command has a session of its own. Whatever it started is killed when it ends or its time is up, also what has left
its process group: orphans become children of this process, which is their subreaper.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import shlex
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

PR_SET_PDEATHSIG = 1
PR_SET_CHILD_SUBREAPER = 36
TIMED_OUT = 124
"""The exit status of a command that ran past its limit, as timeout(1) has it."""
CHECK_S = 0.2
"""How often the time limits are checked."""
NO_RIGHTS = ["--inh-caps=-all", "--ambient-caps=-all"]
ONLY_MOUNTS = ["--inh-caps=-all,+sys_admin", "--ambient-caps=-all,+sys_admin", "--bounding-set=-all,+sys_admin"]
BUSY: set[int] = set()
"""Busy loops that run now."""


@dataclass
class User:
    """The user that a command runs as."""

    uid: int
    gid: int
    home: Path

    @classmethod
    def from_environment(cls) -> User | None:
        """The user of `DEPTHRIG_TEST_USER`; None if nobody asked for one or this process may not change its own."""
        text = os.environ.get("DEPTHRIG_TEST_USER", "")
        if os.geteuid() != 0 or not text:
            return None
        uid, gid, home = text.split(":", 2)
        return cls(int(uid), int(gid), Path(home))


@dataclass
class Box:
    """Settings of a command's run."""

    user: User | None = field(default_factory=User.from_environment)
    mounts: bool = False
    """The command may mount file systems; that is the only right it has beyond those of its user."""
    shm_mib: int | None = None
    """Size of a /dev/shm of its own."""
    nofile: int | None = None
    """Most descriptors of a process."""
    busy: int = 0
    """Busy loops beside the command."""

    def command(self, argv: list[str]) -> list[str]:
        """The command that sets up the box and runs `argv` in it."""
        setup = open_up(self.opened(), self.user) if self.user else []
        if self.shm_mib or self.user:
            # Of its own also without a limit: what killed processes leave there goes with the box.
            size = f"{self.shm_mib}m" if self.shm_mib else "50%"
            setup.append(f"mount -t tmpfs -o size={size},mode=1777 depthrig-test /dev/shm")
        # Signals that were ignored when the tests were started (nohup, a shell's background) would stay ignored.
        inner = ["env", "--default-signal"]
        if self.nofile:
            inner += ["prlimit", f"--nofile={self.nofile}:{self.nofile}"]
        outer: list[str] = []
        if os.geteuid() == 0:
            if setup or self.user:
                outer = ["unshare", "--mount", "--propagation=private"]
            if self.user:
                who = [f"--reuid={self.user.uid}", f"--regid={self.user.gid}", "--clear-groups"]
                inner += ["setpriv", *who, *(ONLY_MOUNTS if self.mounts else NO_RIGHTS)]
        else:
            # mount(8) works for root alone: root of a user namespace, in which the command is this user again.
            if setup:
                outer = ["unshare", "--user", "--map-root-user", "--mount"]
            if setup or self.mounts:
                inner += ["unshare", "--user", f"--map-user={os.geteuid()}", f"--map-group={os.getegid()}"]
            if self.mounts:
                inner += ["--mount", "--keep-caps", "setpriv", *ONLY_MOUNTS]
        return [*outer, "sh", "-c", " && ".join([*setup, 'exec "$@"']), "box", *inner, *argv]

    @staticmethod
    def opened() -> list[Path]:
        """Folders that the user must be able to enter."""
        return [Path(p) for p in os.environ.get("DEPTHRIG_TEST_OPEN", "").split(":") if p]

    def environment(self, env: dict[str, str]) -> dict[str, str]:
        """`env` with folders that the user may write to."""
        if not self.user:
            return env
        home = self.user.home
        own = {"HOME": home, "TMPDIR": home / "t", "XDG_RUNTIME_DIR": home / "r", "XDG_CACHE_HOME": home / "cache"}
        kept = {k: v for k, v in env.items() if k not in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "MAIL")}
        name = {"USER": "depthrig-test", "LOGNAME": "depthrig-test", "PYTHONDONTWRITEBYTECODE": "1"}
        cache = env.get("DEPTHRIG_TEST_CACHE")
        if cache:
            own["XDG_CACHE_HOME"] = Path(cache)
        return {**kept, **{k: str(v) for k, v in own.items()}, **name}

    def run(
        self,
        argv: list[str],
        *,
        limit_s: float | None = None,
        idle_s: float | None = None,
        cwd: Path | None = None,
        env: dict[str, str] | None = None,
        line: Callable[[str], bool] | None = None,
    ) -> int:
        """Runs `argv` and returns its exit status, `TIMED_OUT` if it was killed for its time.

        `limit_s` is for the entire command; `idle_s` is the longest between two lines of its output for which `line`,
        that is given each of them, returns True.
        """
        become_subreaper()
        env = self.environment(dict(os.environ) if env is None else env)
        with busy_loops(self.busy):
            last = [time.monotonic()]
            process = subprocess.Popen(
                self.command(argv),
                cwd=cwd,
                env=env,
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if line else None,
                stderr=subprocess.STDOUT if line else None,
            )

            def read() -> None:
                for raw in process.stdout:
                    if line(raw.decode(errors="replace").rstrip("\n")):
                        last[0] = time.monotonic()

            reader = threading.Thread(target=read, daemon=True)
            if line:
                reader.start()
            in_time = False
            try:
                in_time = wait(process, limit_s, idle_s, last)
            finally:
                left = kill_descendants(process.pid)
                status = process.wait()
                if line:
                    # The other end of the pipe is closed.
                    reader.join()
            if in_time and left:
                print(f"box: killed what {argv[0]} left running: {'; '.join(left)}", file=sys.stderr)
        return (status if status >= 0 else 128 - status) if in_time else TIMED_OUT


def wait(process: subprocess.Popen[bytes], limit_s: float | None, idle_s: float | None, last: list[float]) -> bool:
    """Waits for the end of the process; False if its time was up before."""
    started = time.monotonic()
    while True:
        try:
            process.wait(CHECK_S)
            return True
        except subprocess.TimeoutExpired:
            now = time.monotonic()
            if (limit_s and now - started > limit_s) or (idle_s and now - last[0] > idle_s):
                return False


def become_subreaper() -> None:
    """From now on orphans of this process's descendants are its children."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Loops that keep `count` processors busy; they end with this process, whatever ends it."""
    libc = ctypes.CDLL(None)
    loops = [
        subprocess.Popen(
            ["sh", "-c", "while :; do :; done"],
            preexec_fn=lambda: libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0),
        )
        for _ in range(count)
    ]
    BUSY.update(loop.pid for loop in loops)
    try:
        yield
    finally:
        BUSY.clear()
        for loop in loops:
            loop.kill()
            loop.wait()


def children() -> dict[int, list[int]]:
    """The living children of every process."""
    found: dict[int, list[int]] = {}
    for entry in os.scandir("/proc"):
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError):
            fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
            if fields[0] != "Z":
                found.setdefault(int(fields[1]), []).append(int(entry.name))
    return found


def kill_descendants(command: int) -> list[str]:
    """Kills all descendants of this process but the busy loops; returns the command lines of those that it killed. The
    exit status of the process `command` is left for its owner."""
    killed: dict[int, str] = {}
    while True:
        tree = children()
        todo = [pid for pid in tree.get(os.getpid(), []) if pid not in BUSY]
        living = []
        while todo:
            pid = todo.pop()
            living.append(pid)
            todo += tree.get(pid, [])
        for pid in living:
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
                killed.setdefault(pid, words.decode(errors="replace").strip()[:100])
                os.kill(pid, signal.SIGKILL)
        for pid in adopted():
            if pid != command:
                with contextlib.suppress(ChildProcessError):
                    os.waitpid(pid, os.WNOHANG)
        if not living:
            return list(killed.values())
        time.sleep(0.02)


def adopted() -> list[int]:
    """Children of this process but the busy loops, dead ones too."""
    text = Path(f"/proc/self/task/{os.getpid()}/children").read_text()
    return [pid for pid in map(int, text.split()) if pid not in BUSY]


def closed_ancestor(folder: Path, user: User) -> Path | None:
    """The topmost folder above `folder` that the user may not enter."""
    for ancestor in reversed(folder.resolve().parents):
        status = ancestor.stat()
        bit = stat.S_IXUSR if status.st_uid == user.uid else stat.S_IXGRP if status.st_gid == user.gid else stat.S_IXOTH
        if not status.st_mode & bit:
            return ancestor
    return None


def open_up(folders: list[Path], user: User) -> list[str]:
    """Shell commands that make `folders` reachable: a closed folder above them is covered by an empty one with only these
    in it. Its other contents are invisible in the box."""
    above = {folder.resolve(): closed_ancestor(folder, user) for folder in folders if folder.exists()}
    wanted = {folder: closed for folder, closed in above.items() if closed}
    if not wanted:
        return []
    stage = shlex.quote(str(user.home / "stage"))
    script = [f"mkdir -p {stage}", f"mount -t tmpfs -o mode=0755 depthrig-test {stage}"]
    for number, folder in enumerate(wanted):
        script += [f"mkdir {stage}/{number}", f"mount --bind {shlex.quote(str(folder))} {stage}/{number}"]
    for closed in sorted(set(wanted.values())):
        script.append(f"mount -t tmpfs -o mode=0755 depthrig-test {shlex.quote(str(closed))}")
    for number, folder in sorted(enumerate(wanted), key=lambda item: len(item[1].parts)):
        path = shlex.quote(str(folder))
        script += [f"mkdir -p {path}", f"mount --move {stage}/{number} {path}"]
    # The working folder is still the one below what was covered.
    return [*script, 'cd "$PWD"']


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=float, metavar="SECONDS", help="time limit of the command")
    parser.add_argument("--as-root", action="store_true", help="stay root, if this is root")
    parser.add_argument("--mounts", action="store_true", help="the command may mount file systems")
    parser.add_argument("--shm", type=int, metavar="MIB", help="a /dev/shm of its own of this size")
    parser.add_argument("--nofile", type=int, metavar="N", help="most descriptors of a process")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy loops beside the command")
    parser.add_argument("command", nargs="+")
    args = parser.parse_args()
    box = Box(mounts=args.mounts, shm_mib=args.shm, nofile=args.nofile, busy=args.busy)
    if args.as_root:
        box.user = None
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    signal.signal(signal.SIGHUP, lambda *_: sys.exit(129))
    status = box.run(args.command, limit_s=args.limit)
    if status == TIMED_OUT:
        print(f"box: {args.command[0]} ran past its limit of {args.limit:.0f} s and was killed", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
