"""What may have changed, and what it would do to the trim: linear in its parameters, with priors from physics.

A rotor j with share s_j of the load that loses the fraction l of its thrust and q of its drag torque moves the trim by
l s_j (G_kj - trim_k) in roll and pitch, by q s_j G_3j - l s_j trim_3 in yaw and by l s_j in effort.  A mass w at
(x, y) from the centre, w the part of the loaded vehicle's, moves it by -w y / arm, w x / arm, 0 and w.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from quadid.health.trim_estimation import trim_directions
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

LOSS = 0.2
"""Prior standard deviation of a rotor's loss of thrust."""
DRAG_APART = ((0.02, 0.9), (0.15, 0.1))
"""Prior standard deviations of its loss of drag torque from that of thrust, with their probabilities: a tired motor
loses as much of both, a cut blade nearly so (R^4 and R^5 of its length; a tenth of `LOSS` apart), one with tape or a
bend may lose thrust and gain drag."""
MASS = 0.1
"""Prior standard deviation of an added mass, as a fraction."""
REACH = 0.7
"""An added mass sits this far from the centre, in arms (standard deviation of each coordinate)."""
SHIFT = 0.05
"""Prior standard deviation of a shift of the CG without mass, in arms: a battery that has slid."""
MOST_ROTORS = 3
"""Most rotors that are damaged at once."""
_KINDS = {"weak_rotor": 0.7, "payload": 0.2, "cg_offset": 0.06, "effort": 0.04}
"""Prior odds of the kinds of change; a further damaged rotor costs `_ANOTHER`."""
_ANOTHER = 0.3
_STEP = 0.15
_MASSES = tuple(float(mass) for mass in 0.01 * np.exp(2.0 * _STEP * np.arange(13)))
"""Added masses that are tried, from 1 % in steps of twice `_STEP` (relative), each with that standard deviation."""


class Hypothesis(NamedTuple):
    """One explanation of a change of trim.

    Attributes:
        kind: weak_rotor, payload (mass_change with cg_offset), cg_offset, effort (mass_change or thrust_drop).
        rotors: the damaged ones, from 0.
        effect: change of trim per parameter, shape (4, parameters).
        prior: covariance of the parameters, shape (parameters, parameters).
        centre: their prior mean, shape (parameters,).
        positive: which parameters cannot be negative.
        log_odds: prior.
    """

    kind: str
    rotors: tuple[int, ...]
    effect: FloatArray
    prior: FloatArray
    centre: FloatArray
    positive: tuple[int, ...]
    log_odds: float


def rotor_effect(vehicle: Vehicle, rotor: int, share: float, trim: FloatArray) -> FloatArray:
    """Change of trim per loss of thrust and per loss of drag torque of one rotor, shape (4, 2)."""
    g = trim_directions(vehicle)[:, rotor]
    return share * np.array([[g[0] - trim[0], 0.0], [g[1] - trim[1], 0.0], [-trim[2], g[2]], [1.0, 0.0]])


def hypotheses(vehicle: Vehicle, shares: FloatArray, trim: FloatArray) -> list[Hypothesis]:
    """Every explanation that is compared.

    Args:
        vehicle: geometry.
        shares: each rotor's share of the load in the flights in question, shape (rotors,).
        trim: healthy trim, shape (4,).
    """
    rotors = range(len(vehicle.rotors))
    single = [rotor_effect(vehicle, j, float(shares[j]), trim) for j in rotors]
    out = []
    for count in range(1, min(MOST_ROTORS, len(rotors) - 1) + 1):
        chosen = list(combinations(rotors, count))
        odds = np.log(_KINDS["weak_rotor"] * _ANOTHER ** (count - 1) / len(chosen))
        blocks = [np.array([[LOSS**2, LOSS**2], [LOSS**2, LOSS**2 + apart**2]]) for apart, _ in DRAG_APART]
        priors = [np.kron(np.eye(count), block) for block in blocks]
        for group in chosen:
            effect = np.hstack([single[j] for j in group])
            positive = tuple(range(0, 2 * count, 2))
            for prior, (_, part) in zip(priors, DRAG_APART, strict=True):
                log_odds = float(odds + np.log(part))
                out.append(Hypothesis("weak_rotor", group, effect, prior, np.zeros(2 * count), positive, log_odds))
    return [*out, *_of_mass()]


def _of_mass() -> Sequence[Hypothesis]:
    """Added masses of several sizes at a place, a shifted CG, and more effort alone."""
    shift = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])  # per x and y of the CG, in arms
    effort = np.array([[0.0], [0.0], [0.0], [1.0]])
    odds = {kind: float(np.log(p)) for kind, p in _KINDS.items()}
    weights = np.exp(-0.5 * (np.array(_MASSES) / MASS) ** 2)
    out = []
    for mass, weight in zip(_MASSES, weights / weights.sum(), strict=True):
        prior = np.diag([(REACH * mass) ** 2, (REACH * mass) ** 2, (_STEP * mass) ** 2])
        centre = np.array([0.0, 0.0, mass])
        log_odds = odds["payload"] + float(np.log(weight))
        out.append(Hypothesis("payload", (), np.hstack([shift, effort]), prior, centre, (), log_odds))
    none = np.zeros(2)
    out.append(Hypothesis("cg_offset", (), shift, SHIFT**2 * np.eye(2), none, (), odds["cg_offset"]))
    out.append(Hypothesis("effort", (), effort, np.array([[MASS**2]]), none[:1], (), odds["effort"]))
    return out
