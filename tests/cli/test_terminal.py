"""On a terminal: colours, progress, completion; in a pipe: plain text and nothing else."""

from __future__ import annotations

import os
import pty
import re
import subprocess
from pathlib import Path

import pytest

from tests.cli.conftest import Flights
from tests.commands import QUADID, Cli

COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-7]m")


def on_a_terminal(arguments: list[str], cwd: Path, **environment: str) -> str:
    """Everything that a command writes to a terminal of 120 columns."""
    leader, follower = pty.openpty()
    plain = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR", "CI", "COLUMNS")}
    process = subprocess.Popen(
        [*QUADID, *arguments], stdin=follower, stdout=follower, stderr=follower, cwd=cwd,
        env={**plain, "TERM": "xterm-256color", "COLUMNS": "120", **environment},
    )  # fmt: skip
    os.close(follower)
    parts = []
    while True:
        try:
            part = os.read(leader, 65536)
        except OSError:  # the last writer has closed the terminal
            break
        if not part:
            break
        parts.append(part)
    os.close(leader)
    assert process.wait(timeout=900) == 0
    return b"".join(parts).decode()


def test_a_terminal_gets_progress_and_no_color_is_respected(flights: Flights, tmp_path: Path) -> None:
    arguments = ["identify", str(flights.train), "--vehicle", "pelican", "--out", str(tmp_path)]
    shown = on_a_terminal(arguments, tmp_path)
    assert " % " in shown
    assert "what is missing" in shown
    assert COLOUR.search(shown)
    assert not COLOUR.search(on_a_terminal(["inspect", str(flights.train)], tmp_path, NO_COLOR="1"))
    assert COLOUR.search(on_a_terminal(["inspect", str(flights.train)], tmp_path))


def test_a_pipe_gets_plain_text_and_no_progress(quadid: Cli, flights: Flights, tmp_path: Path) -> None:
    run = quadid("identify", flights.train, "--vehicle", "pelican", "--out", tmp_path)
    assert "\x1b" not in run.out + run.err
    assert "%" not in run.err
    assert "J_xx" in run.out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("quadid i", "inspect"),
        ("quadid identify --vehicle pel", "pelican_x"),
        ("quadid diagnose --val", "--validate"),
    ],
)
def test_the_shell_completes_commands_options_and_vehicles(quadid: Cli, words: str, expected: str) -> None:
    count = str(len(words.split()) - 1)
    run = quadid(_QUADID_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=count)
    assert expected in run.out.split()
