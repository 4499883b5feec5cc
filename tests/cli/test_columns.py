"""`--columns` names the columns of a CSV wherever a log is read."""

from __future__ import annotations

from pathlib import Path

import pytest
from quadid_replay import write_csv

from quadid.app.excite import grouped
from tests.cli.conftest import Flights
from tests.commands import Cli

COMMANDS = {
    "score": (), "replay": ("--diagnose", "0"), "excite": ("--seconds", "6.5"), "fleet": ("--workers", "1"),
}  # fmt: skip


@pytest.fixture(scope="module")
def renamed(flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a flight whose rates are called otherwise."""
    folder = tmp_path_factory.mktemp("logs")
    write_csv(folder / "a.csv", flights.train_flight.recording)
    head, rows = (folder / "a.csv").read_text(encoding="utf-8").split("\n", 1)
    names = [{"p": "gyro_x", "q": "gyro_y", "r": "gyro_z"}.get(name, name) for name in head.split(",")]
    (folder / "a.csv").write_text(",".join(names) + "\n" + rows, encoding="utf-8")
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_columns_are_named_wherever_a_log_is_read(command: str, renamed: Path, inside: Cli, tmp_path: Path) -> None:
    log = renamed if command == "fleet" else renamed / "a.csv"
    out = ("--out", tmp_path) if command in ("excite", "fleet") else ()
    call = (command, log, "--vehicle", "pelican", *COMMANDS[command], *out, "--json", "-")
    named = inside(*call, "--columns", "gyro_x=p,gyro_y=q,gyro_z=r")
    assert named.code in ((0, 3) if command == "replay" else (0,)), named.err  # a short flight publishes nothing yet
    if command == "fleet":
        assert named.data["counts"] == {"done": 1}
    elif command == "replay":
        assert named.data["status"] != inside(*call).data["status"]
    else:
        assert inside(*call).code == 2


def test_equal_movements_are_one_row() -> None:
    moves = [{"name": n, "amplitudes": {"roll": 0.1}} for n in ("a", "a", "b", "a")]
    assert [(name, times) for name, times, _ in grouped(moves)] == [("a", "2"), ("b", "1"), ("a", "1")]
