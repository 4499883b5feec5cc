"""What commands print fits a narrow terminal: lines fold, and every value stands there whole."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
from quadid_evaluation.paper.compare import Methods

from quadid.app.excite import Proposed
from quadid.app.fleet_page import Fleet
from quadid.cli.history import Stored
from quadid.cli.replay import Replayed
from quadid.cli.terminal import conclude
from quadid.parameters import NOMINAL_UNITS
from quadid.report.tables import Column, TextTable

PARAMETERS = [
    {"name": name, "unit": unit, "value": 1.23456e-5 * (i + 1), "ci95": [1.23356e-5 * (i + 1), 1.23556e-5 * (i + 1)],
     "initial": 2e-5, "status": "identified"}
    for i, (name, unit) in enumerate(NOMINAL_UNITS.items())
]  # fmt: skip
SET = {
    "sequence": 3, "wall": 1.7e9, "state": "rolled_back", "approved_by": "operator", "start": 1.0, "stop": 59.0,
    "mse": 1.234, "parameters": PARAMETERS, "reason": "it predicts new windows worse than its predecessor",
}  # fmt: skip
METHOD = {
    "name": "differential_evolution", "mse": {"train": 1.2345, "validate": [2.3456, 3.4567]},
    "mse_paper": {"train": 4.5678}, "evaluations": 4000, "seconds": 12.3, "failures": 1, "runs": 3, "note": "stopped",
}  # fmt: skip
EXCITED = {
    "seconds": 58.5, "worst": "J_r", "gain": 7.3, "manoeuvre_file": "m.yaml", "files": [],
    "parameters": [
        {"name": name, "now": 0.00569, "gentle_flight": 0.00567, "manoeuvre": 0.00409, "one_axis_at_a_time": 0.00543}
        for name in NOMINAL_UNITS
    ],
    "movements": [{"name": "roll + pitch + yaw + throttle, 0.8 to 2 Hz", "amplitudes": {"roll": 0.2, "yaw": 0.15}}],
    "peak": {"tilt_deg": 23.0, "rate_deg_s": 120.0}, "room": {"sideways_m": 5.0, "up_m": 0.1, "down_m": 0.1},
    "envelope": {"lowest_m": 10, "highest_m": 40, "radius_m": 10, "abort_tilt_deg": 32, "battery_percent": 40},
}  # fmt: skip
COMPARED = {"validate": ["other.mcap", "third.mcap"], "methods": [METHOD], "budget": 4000}
REPLAYED = {
    "vehicle": "pelican", "events": [], "refused": {"held_out_gain": 27}, "published": [SET], "status": {},
}  # fmt: skip
STORED = {"vehicle": "pelican", "sets": [SET], "vehicles": [], "candidates": [], "events": [], "in_force": None}
FLEET = {
    "units": [{"unit": "airframe-07", "logs": 2, "done": 2, "parameters": [
        {"parameter": n, "unit": u, "median": 1.23456e-5, "spread": 0.0123} for n, u in NOMINAL_UNITS.items()
    ]}],
    "counts": {"done": 2}, "rough": 0, "drifts": [], "outliers": [], "reasons": [], "health": [], "worked": 2,
    "logs": 2, "copies": [], "seconds": 1.0, "files": [], "report": "fleet.html",
}  # fmt: skip
SHOWN: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "excite": (lambda: conclude(Proposed(EXCITED, *[cast(Any, None)] * 4), None),
               ("0.569 %", "0.567 %", "0.409 %", "0.543 %")),
    "compare": (lambda: conclude(Methods(COMPARED), None),
                ("differential_evolution", "1.234", "2.346", "3.457", "4000", "12.3", "1/3")),
    "fleet": (lambda: conclude(Fleet(FLEET, [], []), None),
              ("airframe-07", "J_xx", "1.235e-05", "N s^2/rad^2", "1.2 %")),
    "replay": (lambda: conclude(Replayed(REPLAYED), None), ("1.2346e-05", "7.4074e-05", "identified", "held out gain")),
    "history": (lambda: conclude(Stored(STORED), None),
                ("operator", "rolled_back", "1.23", "1.235e-05", "7.407e-05", "predecessor")),
}  # fmt: skip


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("command", SHOWN)
def test_every_value_stands_whole(
    command: str, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    show, values = SHOWN[command]
    show()
    text = capsys.readouterr().out
    assert "…" not in text
    assert not [line for line in text.splitlines() if len(line) > width]
    assert not [value for value in values if value not in text]


def test_columns_beyond_the_width_stand_below_with_the_first_beside_them() -> None:
    columns = (Column("set"), *(Column(f"column {i}", right=True) for i in range(5)))
    table = TextTable("t", columns, (("a", "1", "2", "3", "4", "5"),))
    assert table.text(60).splitlines()[1].split("  ")[-1] == "column 4"
    narrow = table.text(25).splitlines()
    assert [line.split()[0] for line in narrow[1:] if line] == ["set", "a"] * 3
    assert max(map(len, narrow)) <= 25
