"""How runs answer to forces and moments that the model lacks, for hundreds of candidates in one pass.

Over one step a state answers linearly to a small force.  The answers to the state itself and to unit forces, chained
over the steps of a run, carry any candidate: what it acts on, times its product of signals along the run.
"""

from __future__ import annotations

import numpy as np

from quadid.identification.open_loop import OpenLoop, initial_states
from quadid.model.layout import Layout, residual_terms
from quadid.model.rollout import Rollout, Segments
from quadid.rotation import turn
from quadid.types import FloatArray, IndexArray, SingleArray
from quadid.vehicle import GRAVITY, SIGNALS, TARGETS, ResidualTerm, Vehicle

TANGENTS = 12
"""Directions of a state: rotation vector, rates, velocity, position."""
_PROBES = (
    *(ResidualTerm(acts_on=target, value=0.0) for target in TARGETS),
    *(ResidualTerm(acts_on="force_x", product=(name,), value=0.0) for name in SIGNALS),
)
"""Terms whose effect over one step gives the answer to unit forces and moments, and the signals."""
_STEP = 1e-4
"""Of a state [rad, rad/s, m/s, m], and of a probe as a share of its typical size, for differences."""
_AT_ONCE = 4096
"""States whose answers are simulated in one call: enough to keep the processor busy, few enough for its cache."""


def typical(vehicle: Vehicle, terms: tuple[ResidualTerm, ...]) -> FloatArray:
    """Sizes at which terms matter on a vehicle, shape (terms,)."""
    return np.array([term.typical(vehicle.mass * GRAVITY, vehicle.arm) for term in terms])


def term_sensitivity(
    loop: OpenLoop, vehicle: Vehicle, candidates: tuple[ResidualTerm, ...], at: IndexArray
) -> SingleArray:
    """Slopes of what runs miss by along the coefficients of candidates, each in units of its typical size.

    A sensor's scale, at most some per cent, is left out: slopes point the way, errors are those of the simulation.

    Args:
        loop: the runs, of `vehicle`.
        vehicle: physics with the terms found so far, about which slopes are taken.
        candidates: terms, those of the vehicle or others.
        at: samples after the start, rising.

    Returns:
        Shape (starts, at, 4, 3, candidates), single precision; quantities as `OpenLoop.parts` orders them.
    """
    numbers = residual_terms(vehicle.model_copy(update={"residual": candidates}))
    acting = [np.flatnonzero(numbers[:, 0] == target) for target in range(len(TARGETS))]
    sizes = typical(vehicle, candidates)
    one_step = _OneStep(loop, vehicle)
    states = one_step.onward(loop.rows, initial_states(loop.window, one_step.theta[0], loop.known)[loop.rows], at[-1])
    slope: SingleArray = np.zeros((len(loop.rows), TANGENTS, len(candidates)), dtype=np.float32)
    out: list[SingleArray] = []
    several = max(_AT_ONCE // max(len(loop.rows), 1), 1)
    for first in range(0, len(states), several):
        some = states[first : first + several]
        rows = loop.rows + np.arange(first, first + len(some))[:, None]
        answers = one_step.answers(rows.ravel(), some.reshape(-1, some.shape[2]))
        by_step = (a.reshape(*rows.shape, *a.shape[1:]) for a in answers)
        for i, (onward, force, found) in enumerate(zip(*by_step, strict=True), first):
            values = np.column_stack([np.ones(len(found)), found])
            products = (sizes * np.prod(values[:, numbers[:, 1:]], axis=2)).astype(np.float32)
            slope = onward @ slope
            for target, columns in enumerate(acting):
                slope[:, :, columns] += force[:, :, target, None] * products[:, None, columns]
            if i + 1 in at:
                out.append(slope)
    by_quantity = np.stack(out, axis=1).reshape(len(loop.rows), len(at), 4, 3, len(candidates))
    return by_quantity[:, :, [3, 2, 0, 1]]  # a state has rotation, rate, velocity, position


class _OneStep:
    """One step of many states at once, with its slopes."""

    def __init__(self, loop: OpenLoop, vehicle: Vehicle) -> None:
        probed = vehicle.model_copy(update={"residual": (*vehicle.residual, *_PROBES)})
        own = Layout(probed).initial(probed)
        self._steps = _STEP * typical(vehicle, _PROBES)
        lanes = 1 + TANGENTS + len(_PROBES)
        self.theta, self._offsets = np.tile(own, (lanes, 1)), np.zeros((lanes, TANGENTS))
        self._offsets[1 : 1 + TANGENTS] = _STEP * np.eye(TANGENTS)
        self.theta[1 + TANGENTS :, len(own) - len(_PROBES) :] += np.diag(self._steps)
        self._rollout = Rollout(loop.padded, probed)

    def onward(self, rows: IndexArray, state: FloatArray, steps: int) -> FloatArray:
        """States along runs from `rows`, before each of so many steps, shape (steps, n, 13)."""
        out = np.empty((steps, *state.shape))
        for i in range(steps):
            out[i] = state
            state = self._ends(rows + i, state, self.theta[:1], None)[0, :, :, 0]
        return out

    def answers(self, rows: IndexArray, state: FloatArray) -> tuple[SingleArray, SingleArray, FloatArray]:
        """What a step from `rows` and states (n, 13) makes of a change.

        Returns:
            Slopes along the 12 directions of the state before (n, 12, 12) and along constant forces and moments
            (n, 12, 6), in single precision; signals, means over the step (n, signals).
        """
        ends = self._ends(rows, state, self.theta, self._offsets)
        after = np.moveaxis(ends, 3, 1).reshape(-1, *state.shape)[: len(self.theta)]
        base, moved = after[0], after[1:]
        before = np.broadcast_to(base[:, :4], (*moved.shape[:2], 4))
        turned = turn(before.reshape(-1, 4), moved[:, :, :4].reshape(-1, 4)).reshape(*moved.shape[:2], 3)
        change = np.concatenate([turned, moved[:, :, 4:] - base[:, 4:]], axis=2).transpose(1, 2, 0)
        onward, probed = change[:, :, :TANGENTS] / _STEP, change[:, :, TANGENTS:] / self._steps
        force, by_signal = probed[:, :, : len(TARGETS)], probed[:, :, len(TARGETS) :]
        along = force[:, :, :1]
        signals = np.sum(by_signal * along, axis=1) / np.sum(along * along, axis=1)
        return onward.astype(np.float32), force.astype(np.float32), signals

    def _ends(self, rows: IndexArray, state: FloatArray, theta: FloatArray, offsets: FloatArray | None) -> FloatArray:
        """States one step after `rows`, shape (blocks, n, 13, lanes)."""
        order = np.argsort(rows, kind="stable")  # rotors turn on from segment to segment
        step = Segments(0, 1, (rows[order] + 1).astype(np.int64))
        ends = self._rollout.roll(step, theta, state[order], offsets)[1]
        return ends[:, np.argsort(order)]
