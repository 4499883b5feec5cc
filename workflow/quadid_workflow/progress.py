"""How long work reports how far it is."""

from __future__ import annotations

from collections.abc import Callable

Advance = Callable[[str, float], None]
"""Called with the name of a stage and the share of it done, 0..1."""


def silent(stage: str, share: float) -> None:
    """Takes no notice."""
