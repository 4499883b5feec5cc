"""Damage hidden in both simulators is found and named; healthy pairs with other batteries and propellers are not."""

from __future__ import annotations

import pytest
from quadid_evaluation.studies.health.simulated import SIMULATORS, Case, judged

TENTH, FIFTH = {2: 0.1}, {3: 0.2}
BOTH = {1: 0.25, 4: 0.15}
HIDDEN = [
    Case("a tenth", TENTH, TENTH),
    Case("a fifth", FIFTH, FIFTH),
    Case("less thrust, more drag", {1: 0.12}, {1: -0.12}),
    Case("two rotors", BOTH, BOTH),
    Case("three rotors", {1: 0.3, 2: 0.2, 3: 0.15}, {1: 0.3, 2: 0.2, 3: 0.15}),
    Case("a weight beside two rotors", mass=0.15, place=(0.02, 0.12)),
    Case("a battery that slid", shift=(0.011, -0.004)),
]


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("number", range(len(HIDDEN)))
def test_hidden_damage_is_named_in_both_simulators(simulator: str, number: int) -> None:
    found = judged(HIDDEN[number], 3 * number + 1, SIMULATORS[simulator])
    assert found.changed
    assert found.right
    if len(HIDDEN[number].losses) == 1:
        assert found.loss < 0.05
        assert found.drag_loss < 0.08


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("size", [0.3, -0.3])
def test_drag_torque_alone_is_a_change_though_its_trims_name_no_rotor(simulator: str, size: float) -> None:
    assert judged(Case("thrust kept", {3: 0.0}, {3: size}), 3, SIMULATORS[simulator]).changed


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_healthy_pairs_are_unchanged_in_both_simulators(simulator: str) -> None:
    assert not any(judged(Case("healthy"), 100 + k, SIMULATORS[simulator]).changed for k in range(4))
