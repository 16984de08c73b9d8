"""Reads and checks the daemon's answers to a process that serves a camera."""

from __future__ import annotations

import time
from typing import Any

from . import _layout as layout
from ._header import unpack_fields
from ._layout import ExternalReason, ExternalWant


class Answer:
    """A decoded answer of the daemon."""

    __slots__ = ("heard", "modes", "reason", "session", "text", "want")

    def __init__(self, values: dict[str, Any], modes: bytes) -> None:
        self.session: int = values["session"]
        self.want = ExternalWant(values["want"])
        self.reason: int = values["reason"]
        self.text: str = values["text"]
        self.modes = modes
        self.heard = time.monotonic()

    @property
    def fresh(self) -> bool:
        """Whether the daemon has been heard lately."""
        return time.monotonic() - self.heard <= layout.EXTERNAL_SILENCE_S

    @property
    def reason_name(self) -> str:
        known = {int(r): r.name.lower() for r in ExternalReason}
        return known.get(self.reason, f"reason {self.reason}")


def read_answer(message: tuple[bytes, bytes], instance: int, modes: int) -> Answer | None:
    """Decode an answer with arbitrary content; None for one that is addressed to another process, or outdated.

    An answer of another version, or an invalid one, counts as a refusal: the two sides cannot communicate.
    """
    head, payload = message
    values = unpack_fields(layout.EXTERNAL_ANSWER_FIELDS, head)
    if values["magic"] != layout.EXTERNAL_ANSWER_MAGIC or values["instance"] != instance:
        return None
    if values["version"] != layout.EXTERNAL_VERSION or values["size"] != layout.EXTERNAL_ANSWER_SIZE:
        return _refusal(
            ExternalReason.VERSION,
            f"it speaks version {values['version']} of the hand-shake, this package version {layout.EXTERNAL_VERSION}; "
            "install the `depthrig` package of the daemon's version",
        )
    if time.monotonic_ns() - values["sent_ns"] > layout.EXTERNAL_SILENCE_S * 1e9:
        return None
    if values["want"] not in list(ExternalWant):
        return _refusal(
            ExternalReason.INVALID,
            f"it wants {values['want']}, which this package does not know; install the `depthrig` package of the "
            "daemon's version",
        )
    if values["want"] == ExternalWant.RUN and not (len(payload) == values["modes"] == modes):
        return _refusal(
            ExternalReason.INVALID,
            f"it answers for {values['modes']} modes in {len(payload)} bytes, and this camera has {modes}",
        )
    values["text"] = "".join(c if c.isprintable() else " " for c in values["text"])
    return Answer(values, payload)


def _refusal(reason: ExternalReason, text: str) -> Answer:
    """Return the refusal for an unusable answer: it belongs to no session, so that every waiting caller gets it."""
    return Answer({"session": 0, "want": ExternalWant.REFUSED, "reason": int(reason), "text": text}, b"")
