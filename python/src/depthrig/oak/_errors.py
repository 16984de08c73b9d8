"""The errors that end the bridge, with their exit codes."""

from __future__ import annotations

import enum

from ..errors import DepthrigError


class Exit(enum.IntEnum):
    """Exit codes of the bridge. The daemon starts it again after each; `USAGE` needs a human to fix."""

    DONE = 0
    """It was stopped, or its files are at their end and the daemon has every frame."""
    FAILED = 1
    """Another failure; the message names it."""
    USAGE = 2
    """The command line, the files or the installation cannot work."""
    NO_CAMERA = 3
    """The camera is missing, or another process holds it."""
    LOST = 4
    """The camera was there and is gone: unplugged, or its firmware stopped."""
    UNDELIVERED = 5
    """Files were played to their end, and the daemon does not have all of their frames; the message says how many."""


class OakError(DepthrigError):
    """The camera cannot be served; the message says why and what to do."""

    def __init__(self, message: str, code: Exit = Exit.FAILED) -> None:
        super().__init__(message)
        self.code = code
        """Exit code of the process."""
