"""RotorPy's Hummingbird, flown by RotorPy itself: every cause is named with RotorPy's numbers, and no other."""

import numpy as np
import pytest
from quadid_evaluation.studies.rotorpy_flight import RotorpyFlight, fly, hummingbird

from quadid.diagnosis.pipeline import diagnose
from quadid.diagnosis.result import Diagnosis, Explanation
from quadid.vehicle import GRAVITY

pytest.importorskip("rotorpy", reason="pip install rotorpy (extra dev)")
SECONDS = 12.0


def diagnosed(flight: RotorpyFlight) -> tuple[dict[str, dict[str, float]], dict[str, float], Diagnosis]:
    """Findings by effect, fitted nominal parameters, and the whole result."""
    result, _ = diagnose([flight.window], flight.vehicle)
    findings = {f.effect: {p.name: p.value for p in f.parameters} for f in result.findings}
    return findings, {p.name: p.value for p in result.parameters}, result


def check_nominal(fitted: dict[str, float], truth: dict[str, float]) -> None:
    for name, key in {"b": "k_eta", "J_xx": "Ixx", "J_yy": "Iyy", "J_zz": "Izz", "d": "k_m"}.items():
        assert fitted[name] == pytest.approx(truth[key], rel=0.01), name


def test_aerodynamics_at_the_hubs_and_a_lag_are_named_with_the_numbers_of_the_simulator() -> None:
    truth = hummingbird(tau_m=0.045)
    findings, fitted, result = diagnosed(fly(truth, SECONDS, seed=1, reach=1.4))
    check_nominal(fitted, truth)
    m = truth["mass"]
    hover = 4.0 * np.sqrt(m * GRAVITY / (4.0 * truth["k_eta"]))
    assert result.verdict is Explanation.EXPLAINED
    assert set(findings) == {"motor_lag", "rotor_drag", "axial_inflow", "parasitic_drag", "translational_lift"}
    assert findings["motor_lag"]["tau"] == pytest.approx(0.045, rel=0.02)
    for axis in ("k_x", "k_y"):
        assert findings["rotor_drag"][axis] == pytest.approx(truth["k_d"] * hover / m, rel=0.03)
    assert findings["axial_inflow"]["k_z"] == pytest.approx(truth["k_z"] * hover / m, rel=0.03)
    assert findings["translational_lift"]["k"] == pytest.approx(4.0 * truth["k_h"] / m, rel=0.1)
    assert findings["parasitic_drag"]["c"] == pytest.approx(truth["c_Dx"] / m, rel=0.25)


def test_without_aerodynamics_nothing_but_the_short_lag_is_named() -> None:
    truth = hummingbird(tau_m=0.005)
    findings, fitted, result = diagnosed(fly(truth, SECONDS, seed=2, aero=False))
    check_nominal(fitted, truth)
    assert result.verdict in (Explanation.EXPLAINED, Explanation.NOTHING_FOUND)
    assert set(findings) <= {"motor_lag"}
    if findings:
        assert findings["motor_lag"]["tau"] == pytest.approx(0.005, abs=5e-4)
