"""Effects that joined the catalogue last: found with their size where they are, and not where a look-alike is."""

import pytest

from quadid.diagnosis import Diagnosis, diagnose
from quadid.flight import draw_truth, fly
from quadid.vehicle import Command, Vehicle
from tests.diagnose.hidden import confident, number
from tests.identify.flights import PELICAN, guessed

READ = PELICAN.model_copy(update={"command": Command(sampling="instant")})
SEED = 12
DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}}
FLOWN: dict[str, tuple[Vehicle, tuple[str, ...], dict[str, dict[str, float]]]] = {
    "late telemetry": (READ, (), {"rotor_telemetry_delay": {"delay": 0.012}}),
    "late motors": (READ, (), {"motor_lag": {"tau": 0.02}}),
    "lift": (PELICAN, ("velocity",), DRAG | {"translational_lift": {"k": 0.02}}),
    "drag in wind": (PELICAN, ("velocity",), DRAG | {"wind": {"north": 4.0, "east": -3.0}}),
    "no gyroscopic coupling": (PELICAN, (), {"no_gyroscopic_coupling": {"share": 1.0}}),
    "emptying battery": (PELICAN, ("battery",), {"supply_voltage": {"exponent": 1.0}}),
    "torque beyond the square": (PELICAN, (), {"drag_torque_curve": {"growth": 1.0}}),
    "slower down": (PELICAN, (), {"motor_lag": {"tau": 0.03, "tau_down": 0.05}}),
    "as slow down": (PELICAN, (), {"motor_lag": {"tau": 0.04}}),
    "weak in thrust": (PELICAN, (), {"weak_rotor": {"rotor": 2.0, "loss": 0.1, "drag_loss": 0.02}}),
    "scaled velocity": (
        PELICAN,
        ("velocity", "position"),
        DRAG | {"velocity_scale": {"horizontal": 0.08, "vertical": -0.15}},
    ),
    "velocity as it is": (PELICAN, ("velocity", "position"), DRAG),
    "weak in both": (PELICAN, (), {"weak_rotor": {"rotor": 2.0, "loss": 0.1}}),
}
"""Each effect beside what looks like it: vehicle, channels beyond the usual, what is hidden."""


def diagnosed(craft: Vehicle, extras: tuple[str, ...], hidden: dict[str, dict[str, float]]) -> Diagnosis:
    """Diagnosis of a flight with hidden effects, from a poor guess."""
    truth, seconds = draw_truth(craft, SEED), 60.0 if "weak_rotor" in hidden else 40.0
    train, unseen = (fly(craft, truth, seconds, SEED + k, effects=hidden, extras=extras).window for k in range(2))
    vehicle = craft.model_copy(update={"parameters": guessed(truth, SEED).parameters})
    return diagnose([train], vehicle, [unseen], seed=SEED)[0]


def tolerance(found: Diagnosis, name: str) -> float:
    """6 %; the drag loss of one weak rotor, which a minute shows to a quarter, to within its interval."""
    if name != "drag_loss":
        return 0.06
    (low, high) = next(p.ci95 for f in found.findings for p in f.parameters if p.name == name)
    return min((high - low) / (high + low), 0.3)


@pytest.mark.parametrize("case", FLOWN)
def test_what_was_hidden_is_named_alone_with_its_size(case: str) -> None:
    craft, extras, hidden = FLOWN[case]
    found = diagnosed(craft, extras, hidden)
    assert sorted(confident(found)) == sorted(hidden), found.to_dict()
    for effect, values in hidden.items():
        for name, value in values.items():
            assert number(found, effect, name) == pytest.approx(value, rel=tolerance(found, name)), found.to_dict()
    assert {p.name for f in found.findings for p in f.parameters} == {n for values in hidden.values() for n in values}
