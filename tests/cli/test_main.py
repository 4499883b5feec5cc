"""The command line as a whole: help, versions, usage errors, quick start."""

from __future__ import annotations

import subprocess
import sys

import pytest
from quadid_cli.main import COMMANDS

from quadid import __version__
from tests.cli.conftest import Cli, one_line


def test_help_lists_every_installed_command(quadid: Cli) -> None:
    run = quadid("--help")
    assert run.code == 0
    for command in COMMANDS:
        assert f"  {command} " in run.out
    assert quadid().out == run.out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_examples_and_json(inside: Cli, command: str) -> None:
    run = inside(command, "--help")
    assert run.code == 0
    assert "--json" in run.out
    assert "Examples:" in run.out


def test_start_imports_nothing_heavy() -> None:
    check = (
        "import sys; sys.argv = ['quadid', '--help']; from quadid_cli.main import app_main; app_main(); "
        "heavy = {'numpy', 'numba', 'scipy', 'pydantic', 'rich', 'plotly', 'yaml'} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_version(inside: Cli) -> None:
    assert inside("--version").out == f"quadid {__version__}\n"


def test_usage_errors_are_one_line(inside: Cli) -> None:
    assert "identify" in one_line(inside("identfy"), 2)
    assert "--vehicle" in one_line(inside("identify", "x.csv"), 2)
    assert "--rat" in one_line(inside("score", "x.csv", "--vehicle", "pelican", "--rat", "5"), 2)
    assert "--seed" in one_line(inside("identify", "x.csv", "--vehicle", "pelican", "--seed", "x"), 2)
