"""Names as `rmw_zenoh` writes them: topics as keys, endpoints as liveliness tokens, and their quality of service.

The format is that of rmw_zenoh from Jazzy (0.2.4) to Rolling; it is described in rmw_zenoh's design document.
"""

from __future__ import annotations

import enum

import xxhash


class Qos(str, enum.Enum):
    """Quality of service of an endpoint, as its token has it: reliability, durability, history, and defaults."""

    SENSOR = "2::,5:,:,:,,"
    """Best effort, the last 5."""
    RELIABLE = "::,10:,:,:,,"
    """Reliable, the last 10."""
    LATCHED = ":1:,1:,:,:,,"
    """Reliable, transient local: who comes later gets the last one."""


def key(domain: int, topic: str, dds_type: str, type_hash: str) -> str:
    """Return the key under which the messages of a topic are published."""
    return f"{domain}/{topic.strip('/')}/{dds_type}/{type_hash}"


def dds_name(ros_type: str) -> str:
    """Return the name of a type such as `sensor_msgs/msg/Image` on the wire: `sensor_msgs::msg::dds_::Image_`."""
    package, _, name = ros_type.split("/")
    return f"{package}::msg::dds_::{name}_"


def part(name: str) -> str:
    """Return a name as one part of a token, in which `%` stands for `/`."""
    return name.replace("/", "%") or "%"


def node_token(domain: int, session: str, node: str) -> str:
    """Return the token of the session's only node, which has number 0."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{part(node)}"


def endpoint_token(domain: int, session: str, node: str, number: int, kind: str, topic: str, about: str) -> str:
    """Return the token of an endpoint of that node.

    `kind` is `MP` for a publisher and `MS` for a subscriber; `about` is type, hash and quality of service.
    """
    return f"@ros2_lv/{domain}/{session}/0/{number}/{kind}/%/%/{part(node)}/{part(topic)}/{about}"


def published_types(token: str) -> tuple[str, str] | None:
    """Return topic and type of a publisher's token; None for any other token."""
    parts = token.split("/")
    # Later versions append parts.
    if len(parts) < 13 or parts[0] != "@ros2_lv" or parts[5] != "MP":
        return None
    return parts[9].replace("%", "/"), parts[10]


def identity(token: str) -> bytes:
    """Return the 16 bytes that identify an endpoint in the attachments of its messages: a hash of its token."""
    digest: int = xxhash.xxh3_128_intdigest(token.encode())
    return digest.to_bytes(16, "little")


def attachment(sequence: int, utc_ns: int, gid: bytes) -> bytes:
    """Return what goes beside each message: its number from 1 on, when it was published, and by which endpoint."""
    return sequence.to_bytes(8, "little") + utc_ns.to_bytes(8, "little", signed=True) + bytes([len(gid)]) + gid


def mount_frame(rig: str) -> str:
    """Return the name of the mount's frame, as recordings have it."""
    return f"{rig}_mount"


def stream_frame(camera: str, stream: str, is_motion: bool) -> str:
    """Return the name of a stream's optical frame, or of an IMU's frame, as recordings have it."""
    return f"{camera}_{stream}_frame" if is_motion else f"{camera}_{stream}_optical_frame"
