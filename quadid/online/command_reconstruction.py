"""Rotor commands where nobody tells them: references through the stabiliser, as the vehicle computes them on board.

A vehicle that publishes its references, its attitude and its rates, and whose stabiliser is known (`stabiliser:` in the
vehicle file), has told its rotor commands too: the control law of `quadid.attitude_controller` makes the one out of the
others.
Commands are computed at the gyro's samples, and act from each until the next; a stabiliser that runs faster than the
gyro comes is run in between on interpolated measurements, and its mean is taken.

What the integrals held when the stream began nobody tells, and a constant torque that is not there spoils inertias.
But a vehicle that flies on does not spin up: over some seconds the torques of its rotors amount to the change of its
angular momentum.  What they exceed it by in the first `CALM` seconds of flight is taken off the integrals; only then
are commands given out.  A lasting torque, as of a CG off centre, cannot be told from the integrals that hold it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quadid.attitude_controller import mixer_matrix, pack_gains, stabilise_rows
from quadid.errors import LogError
from quadid.online.channel_buffer import ChannelBuffer
from quadid.resample import linear
from quadid.resampling_plan import GAP
from quadid.rotation import continuous_sign
from quadid.rotor_signal import RotorSignal
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

NEEDED = ("attitude_reference", "attitude", "gyro")
SOURCE = "references through the stabiliser"
OLDEST = 1.0
"""References and attitude older than this [s] are not steered by, nor those that miss so many of their periods that it
is a gap: what the integrals took in meanwhile nobody knows."""
CALM = 10.0
"""Flight from which the integrals are found [s]."""
AIRBORNE = 0.5
"""With less thrust than this share of the weight nothing is learned, and the integrals rest at zero."""
LANDED = 0.25
"""With less thrust than this share of the weight for a block of rows it has landed, and the integrals begin anew."""
MOST_RUNS = 20
"""Runs of the stabiliser between two samples of the gyro, at most."""


class CommandReconstruction:
    """The stabiliser of one vehicle, run beside the stream."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Prepares for `vehicle`; without a known stabiliser it steers nothing."""
        known = vehicle.stabiliser
        self._gains = pack_gains(known.gains) if known is not None else None
        self._mixer = mixer_matrix(vehicle, known.gains) if known is not None else np.empty((0, 4))
        b, d = (known.gains[n] for n in ("thrust_coefficient", "drag_coefficient")) if known is not None else (0.0, 0.0)
        self._arms = vehicle.torque_arms * [b, b, d]
        self._hover = vehicle.mass * GRAVITY / b if known is not None else math.inf
        self._inertia = np.array([vehicle.parameters[n].initial for n in ("J_xx", "J_yy", "J_zz")])
        self._rate = (known.rate if known is not None else None) or 0.0
        self.restart()
        if self._gains is not None:  # compiled before the first flight, not in it
            still, level = np.zeros((1, 4)), np.array([[1.0, 0.0, 0.0, 0.0]])
            stabilise_rows(
                self._gains, self._mixer, still, level, np.zeros((1, 3)), np.full(1, 0.02), np.zeros(3),
                np.empty((1, len(self._mixer))),
            )  # fmt: skip

    @property
    def known(self) -> bool:
        """Whether the stabiliser is known."""
        return self._gains is not None

    def restart(self) -> None:
        """Begins anew: the stream was interrupted, and nobody knows the integrals."""
        self._integral = np.zeros(3)
        self._newest = -math.inf
        self._rate_then: FloatArray | None = None
        self._settled = False
        self._begin_flight()
        self._t = np.empty(0)
        self._commands = np.empty((0, len(self._mixer)))

    def advance(self, buffers: Mapping[str, ChannelBuffer], until: float, forget: float) -> None:
        """Computes commands up to a time.

        Args:
            buffers: samples by channel.
            until: time [s] up to which all samples are there.
            forget: commands before this time [s] are dropped.
        """
        if self._gains is None:
            return
        reference, attitude, gyro = (buffers[name] for name in NEEDED)
        if min(len(reference.t), len(attitude.t)) < 1 or len(gyro.t) < 2:
            return
        start = max(float(reference.t[0]), float(attitude.t[0]))
        first = max(int(np.searchsorted(gyro.t, self._newest, "right")), int(np.searchsorted(gyro.t, start)))
        # Each command acts until the next sample, which must be known.
        last = min(int(np.searchsorted(gyro.t, until, "right")), len(gyro.t) - 1)
        if last <= first:
            return
        t, period = gyro.t[first : last + 1], float(np.median(np.diff(gyro.t)))
        before = self._newest if math.isfinite(self._newest) else t[0]
        torn = np.flatnonzero(np.diff(t, prepend=before) > GAP * period)
        if len(torn):
            self.restart()
            t = t[torn[-1] :]
            if len(t) < 2:
                return
        commands = self._run(buffers, t, min(max(round(self._rate * period), 1), MOST_RUNS))
        if commands is None or (self._settled and np.mean(commands**2) * len(self._mixer) < LANDED * self._hover):
            self.restart()
            return
        self._newest = float(t[-2])
        if self._settled:
            keep = self._t >= forget
            self._t = np.concatenate([self._t[keep], t[:-1]])
            self._commands = np.concatenate([self._commands[keep], commands])
        else:
            self._settle(np.diff(t), commands, gyro.values[last + 1 - len(t) : last + 1])

    def _run(self, buffers: Mapping[str, ChannelBuffer], t: FloatArray, runs: int) -> FloatArray | None:
        """Commands from each of the times `t` to the next, shape (len(t) - 1, rotors); None: measured too long ago."""
        assert self._gains is not None
        reference, attitude, gyro = (buffers[name] for name in NEEDED)
        at = (t[:-1, None] + np.diff(t)[:, None] * (np.arange(runs) / runs)).ravel()
        held, nearest = (np.searchsorted(buffer.t, at + 1e-9, "right") - 1 for buffer in (reference, attitude))
        for buffer, before in ((reference, held), (attitude, nearest)):
            if (at - buffer.t[before] > _oldest(buffer)).any():
                return None
        commands = np.empty((len(at), len(self._mixer)))
        stabilise_rows(
            self._gains, self._mixer, np.ascontiguousarray(reference.values[held]), _turned(attitude, at),
            linear(gyro.t, gyro.values, at), np.repeat(np.diff(t) / runs, runs), self._integral, commands,
        )  # fmt: skip
        return np.asarray(commands.reshape(len(t) - 1, runs, -1).mean(axis=1))

    def _settle(self, dt: FloatArray, commands: FloatArray, rate: FloatArray) -> None:
        """Adds up torques and angular momentum until they tell the integrals."""
        square = commands**2
        if np.sum(square, axis=1).min() < AIRBORNE * self._hover:
            self._begin_flight()
            return
        if self._rate_then is None:
            self._rate_then = rate[0]
        spin = rate[:-1]
        turning = np.cross(spin, self._inertia * spin)
        self._angular += dt @ (square @ self._arms - turning)
        self._flown += float(dt.sum())
        if self._flown >= CALM:
            self._integral -= (self._angular - self._inertia * (rate[-1] - self._rate_then)) / self._flown
            self._settled = True

    def _begin_flight(self) -> None:
        self._integral[:] = 0.0
        self._angular, self._flown = np.zeros(3), 0.0
        self._rate_then = None

    def signal(self, until: float) -> RotorSignal:
        """The commands up to a time [s]; raises LogError when there are none."""
        count = int(np.searchsorted(self._t, until, "right"))
        if count < 2:
            have = f"{self._flown:.0f} of {CALM:g} s of flight from which its integrals are found"
            fix = "publish rotor speeds or motor commands; or keep flying, with references, attitude and rates"
            raise LogError(f"no rotor speeds, and none yet from references through the stabiliser ({have})", fix=fix)
        return RotorSignal(self._t[:count], self._commands[:count], "held", SOURCE)


def _oldest(buffer: ChannelBuffer) -> float:
    """Age of the newest sample of a channel beyond which it is not steered by [s]."""
    return min(OLDEST, GAP * float(np.median(np.diff(buffer.t)))) if len(buffer.t) > 1 else OLDEST


def _turned(buffer: ChannelBuffer, at: FloatArray) -> FloatArray:
    """Attitudes at times, quaternions, by straight lines between neighbours of the same sign."""
    out = linear(buffer.t, continuous_sign(buffer.values), at)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
