"""The command line for every folder: in a process of its own, or in this one."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from quadid.cli.main import app_main

QUADID = [sys.executable, "-c", "import sys; from quadid.cli.main import app_main; sys.exit(app_main())"]


class Run(NamedTuple):
    """Outcome of a command."""

    code: int
    out: str
    err: str

    @property
    def data(self) -> dict[str, Any]:
        """Stdout as JSON; fails when anything else is there."""
        parsed = json.loads(self.out)
        assert isinstance(parsed, dict)
        return parsed


Cli = Callable[..., Run]


@pytest.fixture(scope="session")
def quadid() -> Cli:
    """Returns a function that runs `quadid` with arguments."""

    def run(*arguments: str | Path, cwd: Path | None = None, **environment: str) -> Run:
        done = subprocess.run(
            [*QUADID, *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=cwd,
            env={**os.environ, "COLUMNS": "160", **environment},
            timeout=1800,  # only a hang: a busy machine may take minutes
            check=False,
        )
        return Run(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture
def inside(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Cli:
    """The same in this process, through the same entry point: many calls cost no start."""
    monkeypatch.setenv("COLUMNS", "160")

    def run(*arguments: str | Path) -> Run:
        monkeypatch.setattr(sys, "argv", ["quadid", *map(str, arguments)])
        capfd.readouterr()
        code = app_main()
        return Run(code, *capfd.readouterr())

    return run


def one_line(run: Run, code: int) -> str:
    """Checks that a command failed with one line and no traceback; returns the line."""
    assert run.code == code, run.err
    lines = [line for line in run.err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, run.err
    assert lines[0].startswith("quadid: ")
    assert "Traceback" not in run.err
    assert run.out == ""
    return lines[0]
