"""Result pages made of parts that are measured at different times: each part is replaced alone, with its date."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path


def put_section(path: Path, title: str, name: str, text: str) -> None:
    """Writes one part of a page, or replaces it where the page has it.

    Args:
        path: the page, made when absent.
        title: heading of a new page.
        name: of the part; kept in a comment that a reader of the page does not see.
        text: Markdown of the part.
    """
    mark = name.replace(" ", "-")
    begin, end = f"<!--{mark}-->", f"<!--/{mark}-->"
    block = f"{begin}\n{text}\n\nMeasured {datetime.now(UTC):%Y-%m-%d}.\n{end}"
    page = path.read_text(encoding="utf-8") if path.exists() else f"# {title}\n"
    pattern = re.compile(re.escape(begin) + r".*?" + re.escape(end), re.DOTALL)
    page = pattern.sub(lambda _: block, page) if pattern.search(page) else f"{page.rstrip()}\n\n{block}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
