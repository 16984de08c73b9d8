#!/usr/bin/env python3
"""Two computers out of one: two network namespaces joined by a wire, one of them with a clock that is SHIFT ns ahead.

    unshare -Urn tests/link/two_hosts.py [--shift NS] [--rate 1gbit] [--load] THERE... -- HERE...

THERE runs on the host 10.77.0.2 whose clock is ahead, and has its standard input until HERE, on 10.77.0.1, has ended. `--load` saturates the
wire both ways with TCP. Needs no privilege but a user namespace.
"""

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import threading
import time

HERE, THERE = "10.77.0.1", "10.77.0.2"
# No multiple of a period of frame sets.
SHIFT_NS = 1_234_567_890_123
# Its children get a clock of their own; `unshare --monotonic` knows whole seconds alone.
ENTER = """
import ctypes, os, sys
if ctypes.CDLL(None, use_errno=True).unshare(0x80): raise OSError(ctypes.get_errno(), 'unshare')
s, ns = divmod(int(sys.argv[1]), 1_000_000_000)
open('/proc/self/timens_offsets', 'w').write(f'monotonic {s} {ns}\\nboottime {s} {ns}\\n')
os.execvp(sys.argv[2], sys.argv[2:])
"""
SINK = """
import socket, threading
def pour(c):
    while c.recv(1 << 16): pass
def push(c):
    data = bytes(1 << 16)
    try:
        while True: c.sendall(data)
    except OSError: pass
s = socket.create_server(("10.77.0.2", 5001))
while True:
    c, _ = s.accept()
    for what in (pour, push): threading.Thread(target=what, args=(c,), daemon=True).start()
"""


def run(*command: str) -> None:
    subprocess.run(command, check=True)


def saturate(stop: threading.Event) -> None:
    deadline = time.monotonic() + 10
    while True:
        with contextlib.suppress(ConnectionRefusedError):
            peer = socket.create_connection((THERE, 5001))
            break
        if time.monotonic() > deadline:
            raise TimeoutError("nobody takes the load")
        time.sleep(0.05)
    data = bytes(1 << 16)

    def drink() -> None:
        with contextlib.suppress(OSError):
            while not stop.is_set() and peer.recv(1 << 16):
                pass

    threading.Thread(target=drink, daemon=True).start()
    while not stop.is_set():
        peer.sendall(data)
    peer.close()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--shift", type=int, default=SHIFT_NS)
    parser.add_argument("--rate", default="1gbit")
    parser.add_argument("--load", action="store_true")
    parser.add_argument("programs", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    os.environ["PATH"] += ":/usr/sbin:/sbin"  # where an ordinary user may not look
    cut = options.programs.index("--")
    there, here = options.programs[:cut], options.programs[cut + 1 :]
    enter = [sys.executable, "-c", ENTER, str(options.shift), "unshare", "-np", "--fork", "--kill-child"]
    settle = f"read -r _; ip addr add {THERE}/24 dev there; ip link set there up; ip link set lo up; "
    limit = f"tc qdisc add dev there root tbf rate {options.rate} burst 128k limit 1m; " if options.rate else ""
    sink = f"{sys.executable} -c '{SINK}' & " if options.load else ""
    script = settle + limit + sink + 'exec "$@"'
    other = subprocess.Popen([*enter, "bash", "-c", script, "bash", *there], stdin=subprocess.PIPE)
    assert other.stdin is not None
    stop = threading.Event()
    try:
        run("ip", "link", "set", "lo", "up")
        run("ip", "link", "add", "here", "type", "veth", "peer", "name", "there")
        # The child of `unshare` is in the namespaces.
        deadline = time.monotonic() + 10
        while not (children := subprocess.run(["pgrep", "-P", str(other.pid)], capture_output=True, text=True, check=False).stdout.split()):
            if time.monotonic() > deadline:
                raise TimeoutError("the other host does not start")
            time.sleep(0.01)
        run("ip", "link", "set", "there", "netns", children[0])
        run("ip", "addr", "add", f"{HERE}/24", "dev", "here")
        run("ip", "link", "set", "here", "up")
        if options.rate:
            run("tc", "qdisc", "add", "dev", "here", "root", "tbf", "rate", options.rate, "burst", "128k", "limit", "1m")
        other.stdin.write(b"\n")
        other.stdin.flush()
        if options.load:
            threading.Thread(target=saturate, args=(stop,), daemon=True).start()
            time.sleep(0.5)
        return subprocess.run(here, check=False).returncode
    finally:
        stop.set()
        other.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            other.wait(2)
        other.kill()
        other.wait()


if __name__ == "__main__":
    sys.exit(main())
