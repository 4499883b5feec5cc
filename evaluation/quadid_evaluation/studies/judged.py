"""What people wrote at the end of a page that a command writes: it outlives the next run."""

from __future__ import annotations

from pathlib import Path

TITLE = "## Judged by hand"


def judged(page: Path) -> str:
    """The page's last section, "Judged by hand", with an empty line before it; empty where there is none."""
    _, title, rest = page.read_text(encoding="utf-8").partition(TITLE) if page.exists() else ("", "", "")
    return f"\n{title}{rest.rstrip()}\n" if title else ""
