"""The zenoh session: configured as `rmw_zenoh` configures those of nodes."""

from __future__ import annotations

import ipaddress
import json
import logging
import os
from typing import Any

import zenoh

log = logging.getLogger("depthrig.ros2")

DEFAULT_ROUTER = "tcp/localhost:7447"
_CONFIG = {
    "mode": "peer",
    "listen/endpoints": ["tcp/localhost:0"],
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2},
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    # Without these targets nothing comes through the router (rmw_zenoh#929).
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "timestamping/enabled": True,
    # With 50 ms, the default, no image of 4.6 MB crosses a link of 200 Mbit/s.
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 2_000_000,
}


class ConfigError(Exception):
    """The session cannot be configured so; the message says why and what to do."""


def open_session(router: str | None, file: str | os.PathLike[str] | None) -> zenoh.Session:
    """Open the session, which looks for its router from then on. `router` is an endpoint such as `tcp/localhost:7447`.

    With a configuration file all other settings are the file's. Raises ConfigError for an invalid one.
    """
    try:
        config = zenoh.Config() if file is None else zenoh.Config.from_file(os.fspath(file))
        for name, value in _CONFIG.items() if file is None else ():
            config.insert_json5(name, json.dumps(value))
        if router is not None or file is None:
            config.insert_json5("connect/endpoints", json.dumps([router or DEFAULT_ROUTER]))
        endpoints = _endpoints(config)
        session = zenoh.open(config)
    except (zenoh.ZError, ValueError, OSError) as e:
        what = f"zenoh's configuration {file}" if file is not None else f"router {router or DEFAULT_ROUTER}"
        raise ConfigError(f"{what} cannot be used ({e}); a router is written as tcp/HOST:PORT") from e
    for endpoint in endpoints:
        if is_open_to_others(endpoint):
            log.warning(
                "router %s is on another computer: this link is neither encrypted nor authenticated, and everybody on "
                "the network can see the images; use TLS (--zenoh-config FILE) or a tunnel of SSH",
                endpoint,
            )
    return session


def _endpoints(config: zenoh.Config) -> list[str]:
    # A list, or one for each mode.
    stated: Any = json.loads(config.get_json("connect/endpoints"))
    lists = stated.values() if isinstance(stated, dict) else [stated]
    return [str(endpoint) for some in lists for endpoint in some or ()]


def is_open_to_others(endpoint: str) -> bool:
    """Whether what is sent to an endpoint leaves this computer unencrypted."""
    protocol, _, address = endpoint.partition("/")
    if protocol in ("tls", "quic", "unixsock-stream", "unixpipe"):
        return False
    host = address.partition("#")[0].partition("?")[0].rpartition(":")[0].strip("[]").partition("%")[0]
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"
