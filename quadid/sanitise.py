"""Text of others (logs, links, files) made fit for people: nothing that a terminal acts on, of bounded length."""

LONGEST_NAME = 200
"""Characters of a name that are shown; no topic, message, column or vehicle has more."""
LONGEST_LINE = 2000
"""Characters of a sentence that are shown."""


def plain(text: str, most: int = LONGEST_NAME) -> str:
    """Returns `text` with control characters as ``?`` and at most `most` characters, the rest as ``…``."""
    shown = text if len(text) <= most else text[: most - 1] + "…"
    return "".join(c if c.isprintable() else "?" for c in shown)


def one_line(text: str, most: int = LONGEST_LINE) -> str:
    """Returns `plain` text with its lines joined, and every run of blanks as one."""
    return plain(" ".join(text.split()), most)
