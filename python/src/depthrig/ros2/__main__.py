"""`depthrig-ros2`: a running rig as topics of ROS 2 with rmw_zenoh, and topics of ROS 2 as signals of the rig."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from .._runtime import runtime_dir as default_runtime_dir
from ..errors import DepthrigError

log = logging.getLogger("depthrig.ros2")

INSTALL = "pip install 'depthrig[ros2]'"
_LARGEST_DOMAIN = 232
_STATUS_S = 10.0

_EXAMPLES = """\
examples:
  depthrig-ros2                                          everything of the only rig that runs
  depthrig-ros2 --streams 'd435/*' --domain 7            the streams of one camera
  depthrig-ros2 --subscribe /joint_states                the robot's joints as signal ros/joint_states

ROS 2 nodes need RMW_IMPLEMENTATION=rmw_zenoh_cpp and a router: ros2 run rmw_zenoh_cpp rmw_zenohd
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code: 0 stopped, 1 failed."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        from . import _bridge, _session
    except ImportError as e:
        log.error("a package is missing (%s); %s", e, INSTALL)
        return 1
    try:
        folder = default_runtime_dir(options.runtime_dir)
        rig = _bridge.wait_for_rig(folder, options.rig, stop)
        if rig is None:
            return 0
        with _session.open_session(options.router, options.zenoh_config) as session:
            bridge = _bridge.Bridge(session, rig, folder, options.domain, options.streams, options.subscribe)
            try:
                bridge.run(stop, _Report(options.json))
            finally:
                bridge.close()
    except (DepthrigError, ValueError, _session.ConfigError) as e:
        log.error("%s", e)
        return 1
    except BrokenPipeError:
        log.error("nobody reads the status any more")
        return 1
    return 0


def run() -> NoReturn:
    """Run the program and end the process."""
    code = main()
    gc.collect()  # the place on the bus goes with the last object that uses it
    logging.shutdown()
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.flush()
    # A thread of zenoh that waits for the interpreter would end the process with SIGABRT when the interpreter ends.
    os._exit(code)


class _Report:
    """Prints the status: a line of JSON each time, or a sentence every 10 s."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._due = time.monotonic() + _STATUS_S

    def __call__(self, status: Mapping[str, Any]) -> None:
        if self._as_json:
            print(json.dumps(status), flush=True)
            return
        if time.monotonic() < self._due:
            return
        self._due += _STATUS_S
        topics = status["topics"].values()
        total = {name: sum(topic[name] for topic in topics) for name in ("sent", "skipped", "missed", "subscribed")}
        log.info(
            "%d of %d topics subscribed, %d messages sent, %d frames skipped, %d samples missed%s",
            *(total["subscribed"], len(topics), total["sent"], total["skipped"], total["missed"]),
            f", {sum(status['signals'].values())} samples received" if status["signals"] else "",
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="depthrig-ros2",
        description="Publish a running rig in the format of ROS 2's rmw_zenoh",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rig", help="rig to use [default: the only one running]")
    parser.add_argument("--runtime-dir", metavar="DIR", help="runtime folder of the rig [default: that of this user]")
    parser.add_argument(
        "--domain",
        type=_domain,
        default=os.environ.get("ROS_DOMAIN_ID") or "0",
        help="ROS domain [default: ROS_DOMAIN_ID, else 0]",
    )
    parser.add_argument("--router", metavar="ENDPOINT", help="zenoh router [default: tcp/localhost:7447]")
    parser.add_argument("--zenoh-config", metavar="FILE", type=Path, help="zenoh configuration, such as one with TLS")
    names = "streams and signals to publish, such as 'd435/*' [default: all]"
    parser.add_argument("--streams", nargs="+", default=[], metavar="PATTERN", help=names)
    topics = "topics of ROS 2 (JointState, PoseStamped) to publish as signals"
    parser.add_argument("--subscribe", nargs="+", default=[], metavar="TOPIC", type=_topic, help=topics)
    parser.add_argument("--json", action="store_true", help="print the status as a line of JSON every second")
    return parser


def _domain(text: str) -> int:
    if not text.isdecimal() or int(text) > _LARGEST_DOMAIN:
        raise argparse.ArgumentTypeError(f"domain {text} is out of range 0..={_LARGEST_DOMAIN}")
    return int(text)


def _topic(text: str) -> str:
    parts = text.strip("/").split("/")
    if not text.startswith("/") or not all(part.replace("_", "a").isalnum() and part.isascii() for part in parts):
        raise argparse.ArgumentTypeError(f"invalid topic {text!r}; write it with its namespace, such as /joint_states")
    return "/" + "/".join(parts)


if __name__ == "__main__":
    run()
