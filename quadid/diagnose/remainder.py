"""What remains after the named causes: is it noise?

The whitened residual of each segment, initial state eliminated, is taken apart into cosine modes.  Pure noise leaves
every mode with the power that the elimination itself leaves it, which is computed with the same projection on drawn
noise.  Modes that stand above the noise model by more than chance are structure, at a frequency, in a channel.  The
noise model comes from a flexible fit and is flat below 3 Hz, so slow structure cannot hide in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.models import Model
from quadid.identify.shooting import Shooting
from quadid.identify.spectrum import mode_power
from quadid.model.rollout import CHANNEL_NAMES

FloatArray = NDArray[np.float64]

SMOOTH = 3
"""Neighbouring modes averaged before they are judged."""
ALARM = 5.0
"""Standard errors above the floor that count as structure; calibrated on flights without effects."""
_ATTITUDE = (3, 4, 5)


@dataclass(frozen=True)
class Structure:
    """Structure left in one channel.

    Attributes:
        channel: its name.
        share: fraction of the channel's residual power that is structure.
        deviance: how much deviance it holds.
        frequency: where it is strongest [Hz].
        errors: how many standard errors its strongest band stands above the floor.
    """

    channel: str
    share: float
    deviance: float
    frequency: float
    errors: float


@dataclass(frozen=True)
class Remainder:
    """All channels; `deviance` sums those with significant structure."""

    channels: tuple[Structure, ...]

    @property
    def deviance(self) -> float:
        """Deviance of the significant structure."""
        return sum(s.deviance for s in self.channels if s.errors > ALARM)

    @property
    def significant(self) -> tuple[Structure, ...]:
        """Channels with structure, strongest first."""
        return tuple(sorted((s for s in self.channels if s.errors > ALARM), key=lambda s: -s.deviance))


def remainder(shooting: Shooting, model: Model, seed: int = 0) -> Remainder:
    """Judges what `model` leaves; attitude channels are left out, their slow noise being modelled, not known."""
    shooting.restore(model.states)
    found, null, segments = mode_power(shooting, model.theta, model.free, np.random.default_rng(seed))
    rate = 1.0 / shooting.dt
    out = []
    for c in range(found.shape[0]):
        if c in _ATTITUDE or not np.isfinite(found[c]).all() or segments[c] < 5:
            continue
        out.append(_judge(CHANNEL_NAMES[c], found[c], null[c], segments[c], rate))
    return Remainder(tuple(out))


def _judge(name: str, found: FloatArray, null: FloatArray, segments: int, rate: float) -> Structure:
    frequency = 0.5 * np.arange(len(found)) * rate / len(found)
    usable = null > 0.3  # modes the initial state takes away say nothing
    kernel = np.ones(SMOOTH)
    weight = np.convolve(usable * null, kernel, mode="same")
    ratio = np.convolve(usable * found, kernel, mode="same") / np.maximum(weight, 1e-9)
    modes = np.convolve(usable.astype(float), kernel, mode="same")
    error = np.sqrt(2.0 / (segments * np.maximum(modes, 1.0)))
    z = np.where(usable, (ratio - 1.0) / error, 0.0)
    k = int(np.argmax(z))
    excess = np.where(usable & (z > 2.0), found - null, 0.0)
    deviance = float(segments * max(np.sum(excess), 0.0))
    share = deviance / max(float(segments * np.sum(found)), 1e-12)
    return Structure(name, share, deviance, float(frequency[k]), float(z[k]))
