"""Two computers out of one, to run programs on and to cut apart: `two_hosts.py`, entered from outside, with an OpenSSH server on the other one.

No privilege is needed but a user namespace. Standard library only: the demo and the tests use it.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

TWO_HOSTS = Path(__file__).with_name("two_hosts.py")
# One that tools/setup.sh fetched.
FETCHED_SSHD = Path(os.environ.get("CARGO_TARGET_DIR", Path(__file__).parents[2] / "target")) / "sshd/usr/sbin/sshd"
HERE, THERE = "10.77.0.1", "10.77.0.2"
SSH_PORT = 2222
# Who logs in on the other host; it is whoever runs this, by another name.
USER, USER_ID = "lab", 1000
SYSTEM_PATH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
WAIT_S = 60.0
# Says its process, as the computer outside knows it, and stays until its input ends.
STAY = "import os, sys; print(os.readlink('/proc/self'), file=open(sys.argv[1], 'w'), flush=True); sys.stdin.read()"


def wait_for(what: str, condition: Callable[[], object], seconds: float = WAIT_S) -> object:
    """What `condition` returns, as soon as it is true."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not within {seconds} s")
        time.sleep(0.05)
    return value


def why_not() -> str | None:
    """Why this computer cannot be two; None if it can."""
    tried = subprocess.run(["unshare", "-UrnT", "true"], capture_output=True, text=True, check=False)
    if tried.returncode != 0:
        return f"this computer gives an ordinary user no namespaces: {tried.stderr.strip()}"
    if shutil.which("ssh-keygen", path=SYSTEM_PATH) is None:
        return "openssh-client is not installed"
    if find_sshd() is None:
        return "no OpenSSH server: `tools/setup.sh test` fetches one"
    return None


def find_sshd() -> str | None:
    return shutil.which("sshd", path=SYSTEM_PATH) or (str(FETCHED_SSHD) if FETCHED_SSHD.is_file() else None)


class TwoHosts:
    """`here` and `there`, joined by a wire of `rate`; a program of either has its clocks, which are `shift_ns` apart, and its network."""

    def __init__(self, folder: Path, shift_ns: int, rate: str = "1gbit") -> None:
        self.folder = folder
        self.rate = rate
        self._ends = ExitStack()
        self._environment: dict[str, str] = {}
        pids = {host: folder / f"{host}.pid" for host in ("here", "there")}
        stays = {host: [sys.executable, "-c", STAY, str(path)] for host, path in pids.items()}
        command = ["unshare", "-Urn", sys.executable, str(TWO_HOSTS), "--shift", str(shift_ns), "--rate", rate, *stays["there"], "--", *stays["here"]]
        self._hosts = self._ends.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE))
        self._ends.callback(self._end)
        read = lambda host: pids[host].exists() and pids[host].read_text().strip()  # noqa: E731
        self._pids = {host: wait_for(f"the process of {host}", lambda host=host: read(host)) for host in pids}

    def _end(self) -> None:
        # An OpenSSH server's connections outlive it.
        there = self._network(self._pids["there"])
        for process in Path("/proc").glob("[0-9]*"):
            if there is not None and self._network(process.name) == there and process.name != self._pids["there"]:
                with suppress(OSError):
                    os.kill(int(process.name), signal.SIGKILL)
        assert self._hosts.stdin is not None
        self._hosts.stdin.close()
        try:
            self._hosts.wait(10)
        except subprocess.TimeoutExpired:
            self._hosts.kill()

    @staticmethod
    def _network(pid: str) -> str | None:
        """The network namespace of a process; None of one that is not ours."""
        try:
            return os.readlink(f"/proc/{pid}/ns/net")
        except OSError:
            return None

    def __enter__(self) -> TwoHosts:
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.close()

    def entering(self, host: str, *command: str) -> list[str]:
        """The command that runs `command` on a host."""
        # This host has the clocks of the computer, which an ordinary user may not enter, being in them.
        clocks = ["-T"] if host == "there" else []
        return ["nsenter", "-t", str(self._pids[host]), "-U", "-n", *clocks, "--preserve-credentials", "--", *command]

    def environment(self, **more: str) -> dict[str, str]:
        return {**os.environ, "PATH": SYSTEM_PATH, **self._environment, **more}

    def run(self, host: str, *command: str, codes: tuple[int, ...] = (0,), **environment: str) -> str:
        """What a command on a host prints."""
        done = subprocess.run(
            self.entering(host, *command),
            env=self.environment(**environment),
            capture_output=True,
            text=True,
            timeout=3 * WAIT_S,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        if done.returncode not in codes:
            raise AssertionError(f"{' '.join(command)} on {host} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout

    def start(self, host: str, log: Path, *command: str, **environment: str) -> subprocess.Popen[bytes]:
        """A program on a host, which ends with this."""
        with log.open("ab") as out:
            program = subprocess.Popen(
                self.entering(host, *command), env=self.environment(**environment), stdout=out, stderr=out, stdin=subprocess.DEVNULL
            )

        def end() -> None:
            program.terminate()
            try:
                program.wait(15)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()

        self._ends.callback(end)
        return program

    def cut(self) -> None:
        """From now on every packet is lost, both ways, and nobody is told."""
        for host in ("here", "there"):
            # A queue of no packets.
            self.run(host, "tc", "qdisc", "replace", "dev", host, "root", "pfifo", "limit", "0")

    def heal(self) -> None:
        """The wire is whole again."""
        for host in ("here", "there"):
            self.run(host, "tc", "qdisc", "replace", "dev", host, "root", "tbf", "rate", self.rate, "burst", "128k", "limit", "1m")

    def serve_ssh(self) -> str:
        """An OpenSSH server on the other host, and a client on this one that knows it by the name it returns."""
        folder = self.folder / "ssh"
        folder.mkdir(mode=0o700)
        for key in ("host", "user"):
            subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / key)], check=True)
        (folder / "authorized").write_text((folder / "user.pub").read_text())
        kind, key, *_ = (folder / "host.pub").read_text().split()
        (folder / "known").write_text(f"[{THERE}]:{SSH_PORT} {kind} {key}\n")
        server = {
            "Port": SSH_PORT,
            "ListenAddress": THERE,
            "HostKey": folder / "host",
            "AuthorizedKeysFile": folder / "authorized",
            "PidFile": "none",
            "UsePAM": "no",
            "StrictModes": "no",
            "PasswordAuthentication": "no",
            "AllowStreamLocalForwarding": "yes",
        }
        client = {
            "HostName": THERE,
            "Port": SSH_PORT,
            "User": USER,
            "IdentityFile": folder / "user",
            "IdentitiesOnly": "yes",
            "UserKnownHostsFile": folder / "known",
            "StrictHostKeyChecking": "yes",
        }
        (folder / "sshd_config").write_text("".join(f"{k} {v}\n" for k, v in server.items()))
        (folder / "ssh_config").write_text("Host left\n" + "".join(f"    {k} {v}\n" for k, v in client.items()))
        # OpenSSH reads the home of the user that the system knows, which is not ours to write to.
        programs = self.folder / "bin"
        programs.mkdir()
        real = shutil.which("ssh", path=SYSTEM_PATH)
        (programs / "ssh").write_text(f'#!/bin/sh\nexec {real} -F {folder / "ssh_config"} "$@"\n')
        (programs / "ssh").chmod(0o755)
        self._environment["PATH"] = f"{programs}:{SYSTEM_PATH}"
        # A server that is root wants to become somebody else, which a namespace of one user cannot give, and whoever runs this need not have a login.
        users = folder / "passwd"
        users.write_text(f"{USER}:x:{USER_ID}:{USER_ID}::{folder}:/bin/sh\n")
        sshd = find_sshd()
        assert sshd is not None, why_not()
        become = ["unshare", "-U", f"--map-user={USER_ID}", f"--map-group={USER_ID}"]
        serve = [*become, sshd, "-D", "-e", "-f", str(folder / "sshd_config")]
        known = 'mount --bind "$1" /etc/passwd && shift && exec "$@"'
        self.start("there", self.folder / "sshd.log", "unshare", "-m", "sh", "-c", known, "sh", str(users), *serve)
        return "left"
