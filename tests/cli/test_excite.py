"""`quadid excite`: limits are kept, the file can be flown, and what was promised is obtained."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from quadid.app.excite import halves_after, made_into_plan, propose
from quadid.errors import ParameterError
from quadid.flight import Segment, fly
from quadid.identification.uncertainty import Uncertainty
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import GRAVITY, Vehicle
from tests.cli.conftest import Flights
from tests.commands import Cli, one_line


def test_a_manoeuvre_from_a_log_keeps_limits_and_promises(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    """With good values to start from, forecast and obtained intervals agree."""
    run = inside(
        "excite", flights.train, "--vehicle", "pelican", "--seconds", "26", "--tilt", "20", "--rate-limit", "120",
        "--out", tmp_path, "--json", "-", "--report", tmp_path / "excite.html",
    )  # fmt: skip
    assert run.code == 0, run.err
    result = run.data
    assert result["schema"] == "quadid.excite/1"
    assert result["peak"]["tilt_deg"] <= 20.0
    assert result["peak"]["rate_deg_s"] <= 120.0
    assert [p["name"] for p in result["parameters"]] == list(NOMINAL_NAMES)
    for p in result["parameters"]:
        # Hover shows b as well as a manoeuvre does.
        assert p["manoeuvre"] < p["gentle_flight"] * (1.01 if p["name"] == "b" else 1.0)
        assert p["gentle_flight"] <= p["now"] * 1.001
    assert "<html" in (tmp_path / "excite.html").read_text(encoding="utf-8")
    file = Path(result["manoeuvre_file"])
    seconds = str(yaml.safe_load(file.read_text(encoding="utf-8"))["seconds"])
    # Where half as fast a grid gives another estimate beyond chance, `identify` adds a third of the difference: of J_r
    # always, about 0.5 %; of d and J_zz on one flight of the manoeuvre and not on the next.
    ratios: dict[str, list[float]] = {name: [] for name in NOMINAL_NAMES}
    for seed in ("9", "10", "11"):
        flown = tmp_path / f"flown{seed}.mcap"
        made = inside(
            "simulate", flown, "--vehicle", "pelican", "--manoeuvre", file, "--seconds", seconds, "--seed", seed
        )
        assert made.code == 0, made.err
        both = inside("identify", flights.train, flown, "--vehicle", "pelican", "--out", tmp_path, "--json", "-")
        for promised, got in zip(result["parameters"], both.data["parameters"], strict=True):
            width = math.sqrt(got["ci95"][1] / got["ci95"][0]) - 1.0
            ratios[got["name"]].append(width / promised["manoeuvre"])
    for name, found in ratios.items():
        assert min(found) > (0.25 if name == "J_r" else 0.75), (name, found)
        assert min(found) < (4.0 if name == "J_r" else 1.25), (name, found)
        assert max(found) < (4.0 if name in ("d", "J_zz", "J_r") else 1.25), (name, found)


def test_without_a_log_the_vehicle_file_says_what_is_known(inside: Cli, tmp_path: Path) -> None:
    run = inside("excite", "--vehicle", "hexacopter", "--seconds", "13", "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    assert len(run.data["movements"]) == 2
    assert run.data["room"]["up_m"] + run.data["room"]["down_m"] < 30.0
    axes = {axis for m in run.data["movements"] for axis in m["amplitudes"]}
    assert {"roll", "pitch", "yaw"} <= axes
    assert np.isfinite(run.data["gain"])
    assert run.data["gain"] > 4.0


@pytest.mark.parametrize(
    "arguments",
    [
        ("--seconds", "1"),
        ("--seconds", "nan"),
        ("--tilt", "0"),
        ("--tilt", "90"),
        ("--rate-limit", "5"),
        ("--height", "40:10"),
        ("--height", "low"),
        ("--battery", "120"),
        ("--format", "lua"),
    ],
)
def test_limits_that_nobody_can_fly(inside: Cli, tmp_path: Path, arguments: tuple[str, str]) -> None:
    line = one_line(inside("excite", "--vehicle", "pelican", "--out", tmp_path, *arguments), 2)
    assert arguments[0] in line


def test_alike_movements_stand_together_and_every_form_is_written(inside: Cli, tmp_path: Path) -> None:
    forms = ("ardupilot-lua", "ardupilot-sid", "px4", "sticks")
    run = inside(
        "excite", "--vehicle", "pelican", "--seconds", "45", "--height", "15:35", "--battery", "55",
        "--out", tmp_path, *(part for form in forms for part in ("--format", form)), "--json", tmp_path / "r.json",
    )  # fmt: skip
    assert run.code == 0, run.err
    result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    names = [m["name"] for m in result["movements"]]
    assert sum(a != b for a, b in pairwise(names)) == len(set(names)) - 1
    counts = [names.count(name) for name in dict.fromkeys(names)]
    assert counts == sorted(counts, reverse=True)
    assert run.out.count(names[0]) == 1
    envelope = result["envelope"]
    assert (envelope["lowest_m"], envelope["highest_m"], envelope["battery_percent"]) == (15.0, 35.0, 55.0)
    assert envelope["radius_m"] >= 2.0 * result["room"]["sideways_m"]
    assert envelope["abort_tilt_deg"] == pytest.approx(1.4 * result["peak"]["tilt_deg"], abs=0.1)
    # All axes together tell more than one at a time, and only together what needs two.
    for p in result["parameters"]:
        assert p["manoeuvre"] <= 1.05 * p["one_axis_at_a_time"], p["name"]
    axes = ("roll", "pitch", "yaw", "throttle")
    ends = [".lua", *(f"sid_{i}_{axis}.param" for i, axis in enumerate(axes, 1)), ".py", ".txt"]
    assert len(result["files"]) == len(ends)
    for path, end in zip(result["files"], ends, strict=True):
        assert path.endswith(end)
        assert "15 to 35 m" in Path(path).read_text(encoding="utf-8")
    compile(Path(result["files"][5]).read_text(encoding="utf-8"), "fly.py", "exec")


def test_random_forces_of_a_vehicle_file_are_in_the_promise() -> None:
    """A manoeuvre flown by ArduCopter was promised J to 0.1 %, and a log of it gave 5 and 12."""
    pelican = Vehicle.shipped("pelican")
    of = {"horizontal": (0.03, 0.3), "vertical": (0.1, 6.0), "roll_pitch": (1.3, 0.16), "yaw": (0.3, 0.8)}
    random = {name: {"sigma": sigma, "time": time} for name, (sigma, time) in of.items()}
    moved = Vehicle.model_validate(pelican.model_dump() | {"random": random})
    alone, beside = (propose(vehicle=one, seconds=13.0) for one in (pelican, moved))
    place = NOMINAL_NAMES.index("J_xx")
    assert beside.proposal.after[place] > 4.0 * alone.proposal.after[place]
    assert "sensor noise alone" in alone.plan.rests_on
    assert "random forces" in beside.plan.rests_on


def test_throttle_at_hover_follows_the_thrust_curve() -> None:
    pelican = Vehicle.shipped("pelican")
    b, full = pelican.parameters["b"].initial, 900.0
    command = {"kind": "pwm", "max_speed": full}
    changes = {"effects": {"thrust_curve": {"dead_speed": 100.0}}, "command": command}
    proposed = propose(vehicle=Vehicle.model_validate(pelican.model_dump() | changes), seconds=6.5)
    hover = pelican.mass * GRAVITY / (4.0 * b * (full - 100.0) ** 2)
    assert proposed.hover_throttle == pytest.approx(hover)


def test_too_little_height_is_refused() -> None:
    pelican = Vehicle.shipped("pelican")
    rising = Segment("throttle", "multisine", 0.0, 6.0, 0.15, 0.3, 1.0)
    flight = fly(pelican, seconds=6.5, profile="scripted", segments=[rising])
    proposal = replace(propose(vehicle=pelican, seconds=6.5).proposal, flight=flight)
    assert proposal.room[1:].sum() > 0.2
    with pytest.raises(ParameterError, match="which the manoeuvre needs"):
        made_into_plan("pelican", proposal, 25.0, (10.0, 10.05), 40.0, disturbed=False)


def test_too_little_time_is_refused(inside: Cli, tmp_path: Path) -> None:
    short = ("excite", "--vehicle", "pelican", "--seconds", "13", "--out", tmp_path)
    # Four sweeps do not fit into so short a time.
    assert "--seconds" in one_line(inside(*short, "--format", "ardupilot-sid"), 2)


def test_what_estimates_of_real_flights_differ_by_is_promised_again() -> None:
    """A simulated flight holds what its model holds: J of a flown log was known a tenth as well as was promised."""
    sigma = np.full(6, 0.004)
    simulated = Uncertainty(np.diag(sigma**2), np.ones(6), np.ones(6))
    steps = np.array([0.0, 0.0, 0.03, 0.0, 0.0, 0.0])
    real = simulated.differing([steps])
    widths = halves_after(simulated, real)
    assert widths[2] == pytest.approx(np.expm1(1.96 * np.hypot(0.004, 0.03)), rel=1e-3)
    np.testing.assert_allclose(np.delete(widths, 2), np.expm1(1.96 * 0.004), rtol=1e-3)
    np.testing.assert_allclose(halves_after(simulated, None), np.expm1(1.96 * sigma), rtol=1e-3)
    np.testing.assert_allclose(halves_after(real, real), widths, rtol=1e-9, err_msg="counted once")
