"""Pages of the documents, followed: every command as it stands there, with what a person fills in."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.commands import Cli


def commands(page: Path, chapter: str = "") -> list[list[str]]:
    """Every `quadid ...` line of the code blocks of a page, or of one of its chapters, without the program's name."""
    text = page.read_text(encoding="utf-8")
    if chapter:
        text = text.split(f"\n## {chapter}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"^```\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("quadid ")]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def follow(page: Path, quadid: Cli, fill_in: Callable[[str], str]) -> dict[str, dict[str, Any]]:
    """Does what "From logs" says in the current folder, which holds its logs; what each command said, by its name.

    Args:
        fill_in: what a person makes of the text of the vehicle file that `init` wrote.
    """
    told: dict[str, dict[str, Any]] = {}
    for name, *arguments in commands(page, "From logs"):
        given = [told["diagnose"]["vehicle_file"] if "…" in a else a for a in arguments]
        run = quadid(name, *given, "--json", "-")
        assert run.code == 0, (name, given, run.err)
        told[name] = run.data
        if name == "init":
            file = Path("my_quad.yaml")
            file.write_text(fill_in(file.read_text(encoding="utf-8")).replace("FILL IN", ""), encoding="utf-8")
    return told
