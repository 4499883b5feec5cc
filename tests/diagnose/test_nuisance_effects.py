"""Effects that any vehicle may have are told from what is larger, an event or a matter of wind and ground."""

from dataclasses import replace

import pytest

from quadid.diagnosis.evidence import ordinary
from quadid.diagnosis.hypotheses import candidates
from tests.diagnose.problems import clean


@pytest.mark.parametrize(
    ("label", "name", "size", "expected"),
    [
        ("weak_rotor 2", "weak_rotor.loss_2", 0.08, False),
        ("weak_rotor 2", "weak_rotor.loss_2", -0.08, False),
        ("weak_rotor 2", "weak_rotor.loss_2", 0.005, True),
        ("cg_offset", "cg_offset.y", -0.0006, True),
        ("cg_offset", "cg_offset.y", -0.002, False),
        ("mass_change", "mass_change.fraction", 0.005, False),
        ("ground_effect", "ground_effect.radius_scale", 0.05, False),
    ],
)
def test_a_cause_is_ordinary_up_to_the_size_that_any_vehicle_has(
    label: str, name: str, size: float, expected: bool
) -> None:
    problem = clean()
    theta = problem.nominal.theta.copy()
    theta[problem.shooting.layout.entry(name).index] = size
    (named,) = [c for c in candidates(problem.shooting.layout, True, True) if c.label == label]
    model = replace(problem.nominal, theta=theta, causes=(named,), free=problem.shooting.free(named.names))
    assert ordinary(model, named) is expected
