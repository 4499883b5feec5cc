"""The commands that README shows, run as written."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from quadid.vehicle import Vehicle
from tests.cli.followed_page import commands
from tests.commands import Cli


def test_commands_of_the_readme_work(
    inside: Cli, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = commands(repository / "README.md", "Use")
    assert len(found) == 7
    for arguments in found:
        run = inside(*arguments)
        assert run.code == 0, (arguments, run.err)
    for file in ("report.html", "pelican.fitted.yaml", "pelican.params"):
        assert (tmp_path / file).is_file()


def test_vehicles_named_in_the_readme_are_shipped(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    named = re.search(r"shipped name \(([^)]*)\)", text)
    assert named is not None
    names = re.findall(r"`(\w+)`", named[1])
    assert sorted(names) == sorted(p.stem for p in (repository / "quadid" / "vehicles").glob("*.yaml"))
    for name in names:
        Vehicle.shipped(name)
