"""The one exception of the lab."""

from __future__ import annotations

__all__ = ["LabError", "first_line"]


class LabError(ValueError):
    """Data, a configuration or a run that cannot be used; the message names the file and what to do."""


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its kind when it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
