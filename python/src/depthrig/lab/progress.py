"""Progress on a terminal."""

from __future__ import annotations

from typing import Any, Protocol

__all__ = ["Bar", "bar"]


class Bar(Protocol):
    """The part of a bar of tqdm that the lab uses."""

    def update(self, n: int = 1) -> Any:
        """So many more are done."""

    def set_postfix(self, **numbers: Any) -> Any:
        """Show numbers behind it."""

    def close(self) -> Any:
        """Leave it as it is."""


class _NoBar:
    def update(self, n: int = 1) -> None:
        """Draw nothing."""

    def set_postfix(self, **numbers: Any) -> None:
        """Draw nothing."""

    def close(self) -> None:
        """Draw nothing."""


def bar(total: int, unit: str, done: int = 0) -> Bar:
    """Return a bar of tqdm, which draws on a terminal only; where tqdm is not installed, one that never draws."""
    try:
        from tqdm import tqdm
    except ImportError:
        return _NoBar()
    return tqdm(total=total, initial=done, unit=unit, disable=None)  # type: ignore[no-any-return,unused-ignore]
