"""What remains after the named causes: is it noise, and does it contradict them?

Two looks: does the residual follow anything the vehicle did (`residual_regressors`), and does its power stand above the
noise?  For the second, the whitened residual of each segment, initial state eliminated, is taken apart into cosine
modes.  Pure noise leaves every mode with the power that the elimination itself leaves it, which is computed with the
same projection on drawn noise.  Modes that stand above the noise model by more than chance are structure, at a
frequency, in a channel.  The noise model is that of a flexible fit, flat below 3 Hz, so slow structure cannot hide
in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.diagnosis.candidates import Candidate
from quadid.diagnosis.model import Model
from quadid.diagnosis.residual_regressors import Follows, follows, strongest
from quadid.effects import EFFECTS
from quadid.identification.noise_estimation import SPECTRUM_SECONDS
from quadid.identification.noise_spectrum import LEAST_LEFT, SMOOTH, band_power, mode_power
from quadid.identification.shooting import Shooting
from quadid.model.rollout import CHANNEL_NAMES
from quadid.types import FloatArray

ALARM = 5.0
"""Standard errors above the floor that count as structure; calibrated on flights without effects."""
CHANGES = ("time", "thrust", "squared thrust", "cubed thrust", "a_x", "a_y", "a_z")
"""How the name of a signal begins that an offset may follow: warming up, vibration, acceleration."""
CHANGE_SHARE = 0.008
"""Share of an offset's own chi-square beyond which it is no offset: an untidy vehicle has a little of everything."""


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
    """What is left, by channel of the residual and by what it follows.

    Attributes:
        channels: power above the noise, one entry a channel.
        sites: what the residual follows at each site.
        rows: independent residuals.
    """

    channels: tuple[Structure, ...]
    sites: tuple[Follows, ...]
    rows: float

    @property
    def deviance(self) -> float:
        """Deviance of the significant structure, by the look that sees more of it; the two overlap."""
        return max(sum(s.deviance for s in self.significant), sum(f.gain.total for f in self.followed))

    @property
    def followed(self) -> tuple[Follows, ...]:
        """Generic causes that predict unseen residuals beyond chance, strongest first."""
        return tuple(f for f in strongest(self.sites) if f.significant)

    @property
    def significant(self) -> tuple[Structure, ...]:
        """Channels with structure, strongest first."""
        return tuple(sorted((s for s in self.channels if s.errors > ALARM), key=lambda s: -s.deviance))

    @property
    def shares(self) -> dict[str, float]:
        """Share of each channel's residual power that is structure, for channels where there is any."""
        out = {s.channel: s.share for s in self.significant}
        rows = self.rows / max(len(self.channels), 1)
        for f in self.followed:
            name = CHANNEL_NAMES[f.site.channels[0][0]]
            out[name] = max(out.get(name, 0.0), min(f.gain.total / rows, 1.0))
        return out


def remainder(shooting: Shooting, model: Model, seed: int = 0) -> Remainder:
    """Judges what `model` leaves; attitude channels are left out, their slow noise being modelled, not known."""
    found, null, segments = mode_power(shooting, model.theta, model.free, np.random.default_rng(seed), model.states)
    rate = 1.0 / shooting.dt
    out = []
    for c in range(found.shape[0]):
        if 3 <= c < 6 or not np.isfinite(found[c]).all() or segments[c] < 5:
            continue
        out.append(_judge(CHANNEL_NAMES[c], found[c], null[c], segments[c], rate))
    return Remainder(tuple(out), follows(shooting, model), model.rows)


def _judge(name: str, found: FloatArray, null: FloatArray, segments: int, rate: float) -> Structure:
    spacing = 0.5 * rate / len(found)
    # The noise spectrum came from the data: a line of vibration narrower than it resolves is noise.
    resolved = SMOOTH / (2.0 * SPECTRUM_SECONDS)
    ratio, modes = band_power(found, null, 2 * round(0.5 * resolved / spacing) + 1)
    usable = null > LEAST_LEFT
    z = np.where(usable, (ratio - 1.0) / np.sqrt(2.0 / (segments * np.maximum(modes, 1.0))), 0.0)
    k = int(np.argmax(z))
    excess = np.where(usable & (z > 2.0), null * (ratio - 1.0), 0.0)
    deviance = float(segments * max(np.sum(excess), 0.0))
    share = deviance / max(float(segments * np.sum(found)), 1e-12)
    return Structure(name, share, deviance, k * spacing, float(z[k]))


def inconstant_causes(model: Model, left: Remainder) -> dict[str, str]:
    """Offsets in `model` that are not constant, and what they follow, by label.

    A bias is constant.  Anything whose mean is not zero looks like one at first: a gyro that senses acceleration, warms
    up or is shaken.  The difference is small beside the mean: the rest at the same sensor follows acceleration,
    thrust or time.  A test of all generic signals together is too blunt for that; each alone is not.
    """
    reasons = {c.label: _inconstant(model, c, left) for c in model.causes}
    return {label: reason for label, reason in reasons.items() if reason}


def _inconstant(model: Model, cause: Candidate, left: Remainder) -> str:
    """What an offset that is not constant follows; empty where it follows nothing, or claims no constancy."""
    kind = EFFECTS[cause.effect].constant_on
    if not kind:
        return ""
    least = max(ALARM**2, CHANGE_SHARE * model.wald(cause))
    followed = [
        (chi_square, f.site.name, signal)
        for f in left.sites
        if f.site.name.startswith(kind)
        for signal, chi_square in f.alone.items()
        # Of sites that look alike from afar the best counts.
        if signal.startswith(CHANGES)
        and chi_square >= max(g.alone[signal] for g in left.sites if g.site.group == f.site.group)
    ]
    chi_square, site, signal = max(followed, default=(0.0, "", ""))
    return f"{cause.effect} is not constant (what remains at {site} follows {signal})" if chi_square > least else ""
