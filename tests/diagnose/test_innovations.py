"""Numbers of a diagnosis: by innovations, sharper than by segments, and right beside moments that no model has."""

import numpy as np
import pytest

from quadid.diagnosis import Diagnosis, diagnose, pipeline
from quadid.diagnosis.result import Explanation
from quadid.flight import draw_truth, fly
from quadid.identification.filter_error import filtered
from quadid.identification.fit import SWARM_SECONDS
from quadid.identification.problem import Shooting
from quadid.identification.uncertainty import uncertainty
from quadid.parameters import NOMINAL_NAMES, UNKNOWN, Status
from quadid.vehicle import Vehicle
from tests.identify.flights import PELICAN, guessed

SEED = 2
GUSTS = {"gusts": {"push": 0.5, "turn": 1.0, "time": 0.5}}
"""Turbulence that turns the vehicle by 1 rad/s^2, with a memory of half a second."""
HELD = ("b", "J_xx", "J_yy")


def diagnosed(seed: int = SEED, **effects: dict[str, float]) -> Diagnosis:
    """Diagnosis of a flight through turbulence, from a poor guess.

    The simulator shares no equation with the model.
    """
    truth = draw_truth(PELICAN, seed)
    window = fly(PELICAN, truth, 60.0, seed, effects=effects, outside=GUSTS).window
    return diagnose([window], guessed(truth, seed))[0]


def errors(found: Diagnosis, seed: int = SEED) -> dict[str, float]:
    """Relative errors of what is held."""
    truth = draw_truth(PELICAN, seed).as_dict()
    return {p.name: p.value / truth[p.name] - 1.0 for p in found.parameters if p.name in HELD}


def test_turbulence_does_not_pass_for_inertia() -> None:
    found, truth = diagnosed(), draw_truth(PELICAN, SEED).as_dict()
    assert found.verdict is Explanation.UNKNOWN
    assert not found.findings, "gusts are random forces, no cause of the catalogue"
    assert max(map(abs, errors(found).values())) < 0.04, errors(found)
    parameters = {p.name: p for p in found.parameters}
    for name in ("J_xx", "J_yy"):
        assert parameters[name].ci95[0] < truth[name] < parameters[name].ci95[1]
        assert parameters[name].status not in UNKNOWN
    for name in NOMINAL_NAMES:
        assert parameters[name].ci95[0] < truth[name] < parameters[name].ci95[1], name
    assert any("random forces" in w for w in found.warnings)
    written = Vehicle.from_yaml(found.vehicle_yaml).parameters
    known = [n for n in HELD if parameters[n].status is Status.IDENTIFIED]
    assert known
    assert all(written[n].initial == pytest.approx(parameters[n].value, rel=1e-6) for n in known)


def test_by_segments_alone_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "fit_numbers", lambda *_: None)
    found = diagnosed()
    assert max(errors(found).values()) > 0.2, errors(found)
    assert not {p.status for p in found.parameters} & {Status.IDENTIFIED, Status.RATIO_ONLY}


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_nor_does_it_beside_a_cause_that_is_found(seed: int) -> None:
    """Without the cause it would count as a random moment."""
    found = diagnosed(seed, cg_offset={"x": 0.01, "y": -0.01})
    assert [f.effect for f in found.findings if f.confident] == ["cg_offset"]
    assert max(map(abs, errors(found, seed).values())) < 0.05, errors(found, seed)


def test_a_lag_in_turbulence_is_neither_a_delay_nor_drag() -> None:
    """Segments simulated freely take it for a command delay, and the gusts for parasitic drag."""
    found = diagnosed(motor_lag={"tau": 0.04})
    assert [f.effect for f in found.findings] == ["motor_lag"]
    (tau,) = found.findings[0].parameters
    assert tau.ci95[0] < 0.04 < tau.ci95[1]


def test_they_are_sharper_than_those_of_segments() -> None:
    """A whole flight shows more of it than segments do, each of which finds a state of its own."""
    hidden = {"rate_damping": {"l_p": 0.3, "m_q": 0.3, "n_r": 0.23}}
    truth, guess = draw_truth(PELICAN, SEED), guessed(draw_truth(PELICAN, SEED), SEED)
    found, search = diagnose([fly(PELICAN, truth, 60.0, SEED, effects=hidden).window], guess)
    widths = {p.name: (p.ci95[1] - p.ci95[0]) / p.value / 2.0 for p in found.parameters}
    by_segments = uncertainty(search.model.lin, search.model.prior).sigma[: len(NOMINAL_NAMES)]
    for p, sigma in zip(found.parameters, by_segments, strict=True):
        assert p.name == "b" or widths[p.name] < 1.96 * sigma, p
        assert p.value == pytest.approx(truth.as_dict()[p.name], rel=2.0 * widths[p.name]), p
    assert widths["d"] < 0.005
    assert widths["J_r"] < 0.02


def test_what_brakes_vertically_is_found_in_a_calm_flight() -> None:
    """States follow the model alone for the whole flight where nothing random acts, and so must what air does."""
    hidden = {"rotor_drag": {"k_x": 0.4, "k_y": 0.4}, "axial_inflow": {"k_z": 0.8}}
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, 40.0, SEED, effects=hidden, extras=("velocity",)).window
    problem = Shooting.cut([window], PELICAN, SWARM_SECONDS)
    names = [*NOMINAL_NAMES, "rotor_drag.k_x", "rotor_drag.k_y", "axial_inflow.k_z"]
    theta, free = problem.layout.initial(PELICAN), problem.free(names)
    theta[free.index] = [*(truth.as_dict()[n] for n in NOMINAL_NAMES), 0.4, 0.4, 0.8]
    found = filtered([window], PELICAN, theta, free)
    assert found is not None
    np.testing.assert_allclose(found.theta[free.index][[0, 2, 3, 8]], theta[free.index][[0, 2, 3, 8]], rtol=0.02)


def test_a_known_bias_of_the_accelerometer_is_taken_off_without_a_velocity() -> None:
    """Along the thrust it cannot be told from it there, so the number of the vehicle file holds."""
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, 30.0, SEED, effects={"accel_bias": {"x": 0.0, "y": 0.0, "z": -0.3}}).window
    problem = Shooting.cut([window], PELICAN, SWARM_SECONDS)
    theta, free = problem.layout.initial(PELICAN), problem.free(NOMINAL_NAMES)
    theta[free.index] = [truth.as_dict()[n] for n in NOMINAL_NAMES]
    theta[problem.layout.entry("accel_bias.z").index] = -0.3
    found = filtered([window], PELICAN, theta, free)
    assert found is not None
    assert found.theta[0] == pytest.approx(truth.as_dict()["b"], rel=0.002)
