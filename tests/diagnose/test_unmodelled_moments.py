"""Moments that no model has: a diagnosis must not write the inertias into its file that they pass for."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.diagnosis import Diagnosis, diagnose
from quadid.diagnosis.hypotheses import Model, fit_model
from quadid.diagnosis.unmodelled_moments import held_by_filter
from quadid.flight import draw_truth, fly
from quadid.identification import filter_error
from quadid.identification.problem import Shooting
from quadid.identification.search import SWARM_SECONDS
from quadid.parameters import NOMINAL_NAMES, UNKNOWN, Status
from quadid.vehicle import Vehicle
from tests.diagnose.problems import cause, clean, fitted, window_with
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


def test_without_random_forces_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filter_error, "WHITE_SHARE", 0.0)
    found = errors(diagnosed())
    assert max(found.values()) > 0.2, found


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_nor_does_it_beside_a_cause_that_is_found(seed: int) -> None:
    """Without the cause it would count as a random moment."""
    found = diagnosed(seed, cg_offset={"x": 0.01, "y": -0.01})
    assert "cg_offset" in {f.effect for f in found.findings}
    assert max(map(abs, errors(found, seed).values())) < 0.05, errors(found, seed)


def held(window: Window, shooting: Shooting, model: Model) -> object:
    """Values of a model that are held."""
    short = Shooting.cut([window], shooting.vehicle, SWARM_SECONDS, shooting.noise, shooting.layout)
    return held_by_filter([window], short, model)


def test_a_model_that_leaves_noise_keeps_its_numbers() -> None:
    problem = clean()
    assert held(problem.window, problem.shooting, problem.nominal) is None


def test_a_cause_that_is_known_is_no_random_moment() -> None:
    """An offset of the centre of gravity turns the vehicle with thrust: unknown it rules the rates."""
    problem = fitted(window_with({"cg_offset": {"x": 0.01, "y": -0.01}}))
    known = (cause(problem, "cg_offset"),)
    model = fit_model(problem.shooting, problem.nominal.theta, known, iterations=10)
    off = problem.nominal.theta[2:4] / model.theta[2:4] - 1.0
    assert np.max(np.abs(off)) > 0.3, off
    assert held(problem.window, problem.shooting, model) is None
