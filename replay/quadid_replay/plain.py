"""Names from untrusted logs, made fit for one line of text that people read."""

from __future__ import annotations

LONGEST_NAME = 200
"""Characters of a name that are shown; no topic, message or column of a true log has more."""


def plain(text: str, most: int = LONGEST_NAME) -> str:
    """Returns `text` with control characters as ``?`` and at most `most` characters, the rest as ``…``."""
    shown = text if len(text) <= most else text[: most - 1] + "…"
    return "".join(c if c.isprintable() else "?" for c in shown)
