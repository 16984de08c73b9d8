"""The one exception of the lab."""

from __future__ import annotations

__all__ = ["LabError"]


class LabError(ValueError):
    """Data, a configuration or a run that cannot be used; the message names the file and what to do."""
