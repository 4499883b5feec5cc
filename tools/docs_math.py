"""Hook of mkdocs: LaTeX between dollar signs becomes MathML, which browsers draw without any script.

`$$ ... $$` on lines of their own is a displayed equation, `$...$` one in the text; code is left alone.
"""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

_CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
_BLOCK = re.compile(r"^\$\$\s*(.+?)\s*\$\$$", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"(?<![\\$\w])\$([^$\n]+?)\$(?![\w$])")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replaces the equations of a page outside of code."""
    parts = _CODE.split(markdown)
    return "".join(part if i % 2 else _equations(part) for i, part in enumerate(parts))


def _equations(text: str) -> str:
    text = _BLOCK.sub(lambda m: f'\n<div style="margin: 0.8em 0">{convert(m[1], display="block")}</div>\n', text)
    # Within a span: to Markdown an element "math" at the begin of a line would be a block of its own.
    return _INLINE.sub(lambda m: f"<span>{convert(m[1])}</span>", text)
