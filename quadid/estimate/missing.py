"""The missing force and moment: what acted on the vehicle and its model does not produce, with bands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.estimate import kalman as k
from quadid.estimate.fit import Estimate
from quadid.types import FloatArray


@dataclass(frozen=True)
class Missing:
    """Of one flight, body axes.

    Attributes:
        t: times [s], shape (n,).
        force: smoothed random force [N], shape (n, 3).
        force_sigma: its standard deviation, shape (n, 3).
        moment: smoothed random moment [N m], shape (n, 3).
        moment_sigma: its standard deviation, shape (n, 3).
        control: root mean square of the rotors' moment about its mean [N m], shape (3,).
    """

    t: FloatArray
    force: FloatArray
    force_sigma: FloatArray
    moment: FloatArray
    moment_sigma: FloatArray
    control: FloatArray

    @property
    def force_rms(self) -> FloatArray:
        """Root mean square force [N], shape (3,): what is expected of it, its uncertainty included."""
        return np.asarray(np.sqrt(np.mean(self.force**2 + self.force_sigma**2, axis=0)))

    @property
    def moment_rms(self) -> FloatArray:
        """Root mean square moment [N m], shape (3,)."""
        return np.asarray(np.sqrt(np.mean(self.moment**2 + self.moment_sigma**2, axis=0)))


def missing(found: Estimate) -> list[Missing]:
    """Smoothed random force and moment of every flight (Bryson & Frazier; see `quadid.estimate.kalman`)."""
    out = []
    _, gains = found.problem.passes(found.z, found.psi)
    for j, (track, g) in enumerate(zip(found.problem.tracks, gains, strict=True)):
        p = found.problem.physics(found.z, j)
        _, mean, variance = k.backward(track, p, found.psi, g, True)
        sigma, inertia = np.sqrt(np.maximum(variance, 0.0)), p[k.JX : k.JX + 3]
        moment = 0.5 * (g.table[:-1, 1:4] + g.table[:-1, k.MOMENTS + 1 : k.MOMENTS + 4])
        arms = np.std(moment, axis=0)[[1, 0, 2]] * [p[k.B], p[k.B], p[k.D]]
        out.append(
            Missing(
                track.t,
                track.mass * mean[:, :3],
                track.mass * sigma[:, :3],
                inertia * mean[:, 3:6],
                inertia * sigma[:, 3:6],
                arms,
            )  # fmt: skip
        )
    return out
