"""Imports `depthai`, checks that its version was tested, and configures it."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from ._errors import Exit, OakError

if TYPE_CHECKING:
    from types import ModuleType

INSTALL = "pip install './python[oak]' in a checkout of depthrig"
_LEAST = (3, 12)


def load() -> Any:
    """Import `depthai` and return it.

    Raises OakError when it is not installed, or older than what the bridge was tested with.
    """
    # A camera that reconnects by itself has another clock and another frame counter, without any notice: the
    # bridge ends instead, and the daemon starts it again.
    os.environ.setdefault("DEPTHAI_RECONNECT_TIMEOUT", "0")
    os.environ.setdefault("DEPTHAI_LEVEL", "warn")
    try:
        dai = importlib.import_module("depthai")
    except ImportError as e:
        raise OakError(f"the `depthai` package cannot be imported ({e}); {INSTALL}", Exit.USAGE) from e
    check_version(dai)
    return dai


def check_version(dai: ModuleType | Any) -> None:
    """Raise OakError unless `dai` is of version 3.12 or a later 3."""
    version = str(getattr(dai, "__version__", "?"))
    try:
        major, minor = (int(part) for part in version.split(".")[:2])
    except ValueError:
        major, minor = 0, 0
    if major != _LEAST[0] or (major, minor) < _LEAST:
        raise OakError(f"`depthai` {version} is installed, 3.12 or a later 3 is needed; {INSTALL}", Exit.USAGE)
