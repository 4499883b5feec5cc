"""The command line as a whole: help, versions, usage errors, quick start."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from quadid.cli.commands import COMMANDS
from quadid.cli.main import BLAS_THREADS
from quadid.version import __version__
from tests.commands import Cli, one_line


def test_help_lists_every_installed_command(quadid: Cli) -> None:
    run = quadid("--help")
    assert run.code == 0
    for command in COMMANDS:
        assert f"  {command} " in run.out
    assert quadid().out == run.out


def test_the_list_of_commands_is_whole_on_a_narrow_terminal(quadid: Cli) -> None:
    text = " ".join(quadid("--help", COLUMNS="60").out.split())
    assert all(command.short in text for command in COMMANDS.values())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_examples_and_json(inside: Cli, command: str) -> None:
    run = inside(command, "--help")
    assert run.code == 0
    assert "--json" in run.out
    assert "Examples:" in run.out


def test_start_imports_nothing_heavy() -> None:
    check = (
        "import sys; sys.argv = ['quadid', '--help']; from quadid.cli.main import app_main; app_main(); "
        "heavy = {'numpy', 'numba', 'scipy', 'pydantic', 'rich', 'plotly', 'yaml'} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_linear_algebra_takes_one_thread_unless_told_otherwise(given: dict[str, str], used: str) -> None:
    check = (
        "import os, sys; sys.argv = ['quadid', '--version']; from quadid.cli.main import app_main; app_main(); "
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    unset = {n: v for n, v in os.environ.items() if n not in BLAS_THREADS}
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=True, env={**unset, **given}
    )
    assert done.stdout.split()[-1] == used


def test_version(inside: Cli) -> None:
    assert inside("--version").out == f"quadid {__version__}\n"


def test_usage_errors_are_one_line(inside: Cli) -> None:
    assert "identify" in one_line(inside("identfy"), 2)
    assert "--vehicle" in one_line(inside("identify", "x.csv"), 2)
    assert "--rat" in one_line(inside("score", "x.csv", "--vehicle", "pelican", "--rat", "5"), 2)
    assert "--seed" in one_line(inside("identify", "x.csv", "--vehicle", "pelican", "--seed", "x"), 2)
