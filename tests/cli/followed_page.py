"""A page for users of an autopilot, "From logs": every command as it stands there, with what a person fills in."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.cli.conftest import Cli


def from_logs(page: Path) -> list[list[str]]:
    """The commands of the page's chapter "From logs", as a shell splits them, without the program's name."""
    block = page.read_text(encoding="utf-8").split("## From logs\n```\n")[1].split("```")[0]
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines()]


def follow(page: Path, quadid: Cli, fill_in: Callable[[str], str]) -> dict[str, dict[str, Any]]:
    """Does what the page says in the current folder, which holds its logs; what each command said, by its name.

    Args:
        page: of the documents.
        quadid: the program.
        fill_in: what a person makes of the text of the vehicle file that `init` wrote.
    """
    told: dict[str, dict[str, Any]] = {}
    for name, *arguments in from_logs(page):
        given = [told["diagnose"]["vehicle_file"] if "…" in a else a for a in arguments]
        run = quadid(name, *given, "--json", "-")
        assert run.code == 0, (name, given, run.err)
        told[name] = run.data
        if name == "init":
            file = Path("my_quad.yaml")
            file.write_text(fill_in(file.read_text(encoding="utf-8")), encoding="utf-8")
    return told
