"""Thrust that falls with the square of a climb: found with its size, and neither a step nor the frame's drag."""

from pathlib import Path

import pytest

import quadid
from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.flight import draw_truth, fly
from quadid.flight.pilot import Segment
from tests.diagnose.hidden import confident, number
from tests.identify.flights import PELICAN, guessed

SEED, SECONDS = 12, 60.0
SWELL = [
    Segment("throttle", "sine", 0.0, SECONDS, 0.45, 0.09),
    Segment("throttle", "noise", 0.0, SECONDS, 0.08, 0.2, 2.0),
    Segment("roll", "noise", 0.0, SECONDS, 0.12, 0.1, 1.5),
    Segment("pitch", "noise", 0.0, SECONDS, 0.12, 0.1, 1.5),
    Segment("yaw", "noise", 0.0, SECONDS, 0.5, 0.1, 0.7),
]
"""Climbs and descents of 3 m/s, one after the other."""
LINEAR = {"axial_inflow": {"k_z": 0.3}}
HIDDEN: dict[str, dict[str, dict[str, float]]] = {
    "square": {"axial_inflow": {"k_z": 0.3, "k_climb": 0.05}},
    "linear alone": LINEAR,
    "drag of the frame": LINEAR | {"parasitic_drag": {"c": 0.04}},
    "mass taken up": LINEAR | {"mass_change": {"time": 31.0, "fraction": 0.1}},
}


def climbing(hidden: dict[str, dict[str, float]], seed: int) -> Window:
    return fly(
        PELICAN,
        draw_truth(PELICAN, SEED),
        SECONDS,
        seed,
        "scripted",
        effects=hidden,
        extras=("velocity",),
        segments=SWELL,
        altitude=40.0,
    ).window


@pytest.mark.parametrize("case", HIDDEN)
def test_in_climbs_and_descents_what_was_hidden_is_named_alone_with_its_size(case: str) -> None:
    hidden = HIDDEN[case]
    vehicle = PELICAN.model_copy(update={"parameters": guessed(draw_truth(PELICAN, SEED), SEED).parameters})
    found = diagnose([climbing(hidden, SEED)], vehicle, [climbing(hidden, SEED + 1)], seed=SEED)[0]
    assert sorted(confident(found)) == sorted(hidden), found.to_dict()
    for effect, values in hidden.items():
        for name, value in values.items():
            assert number(found, effect, name) == pytest.approx(value, rel=0.06), found.to_dict()
    assert {p.name for f in found.findings for p in f.parameters} == {n for values in hidden.values() for n in values}


@pytest.mark.slow
@pytest.mark.parametrize(("log", "vehicle"), [("x.bin", "sitl_x.yaml"), ("quad_sq.bin", "quad_sq.yaml")])
def test_the_end_of_a_long_climb_of_arducopter_is_no_step_of_mass_or_thrust(
    log: str, vehicle: str, data_dir: Path
) -> None:
    """17 s at 2.5 m/s.  With density, curve and drag as in its source, a regression of x has 0.0255 1/m."""
    folder = data_dir / "ardupilot_sitl"
    found = quadid.diagnose(quadid.load(folder / log, vehicle=folder / vehicle)).result
    values = {f["effect"]: {p["name"]: p["value"] for p in f["parameters"]} for f in found["findings"]}
    assert not {"mass_change", "thrust_drop", "battery_sag"} & set(values), values
    if log == "x.bin":
        assert values["axial_inflow"]["k_climb"] == pytest.approx(0.0255, abs=0.005), values
