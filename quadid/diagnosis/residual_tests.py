"""Tests of what remains after the named causes: is it noise, what does it follow, does it contradict them?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import CHANNEL_NAMES, Window
from quadid.diagnosis.hypotheses import Candidate, Gain, Model, Named, held_out, paired_gain
from quadid.effects import EFFECTS
from quadid.identification.elimination import freed
from quadid.identification.fit import LEAST_LEFT, SMOOTH, SPECTRUM_SECONDS, band_power, mode_power
from quadid.identification.problem import Columns, Shooting
from quadid.rotation import product
from quadid.types import FloatArray

# --- What remains, held against generic causes: does the residual follow anything that the vehicle did?
#
# A spectrum sees structure only where it stands above the noise.  Something that follows a command, a motion or the
# time is seen far below that.  Each probe is a signal (an input, its square, its change, a predicted motion, a slow
# function of time) acting at a site: as a moment, a force, an error of the gyro or of the attitude.  Its whitened
# response, less what initial states and free parameters take up, is fitted on all blocks but one and judged on that
# one, so a probe that follows only noise loses.
#
# No signal may share noise with the residual: motions are the predicted ones, and inputs are those of the step before a
# sample, because a controller's command answers to the noise of the sample that it was worked out from; so are specific
# forces, which follow the command at once.


ERRORS = 2.5
"""Standard errors of a gain on unseen blocks above which a site counts as structured."""
RIDGE = 1e-6
"""Prior precision of a probe, relative to its information: keeps signals finite that double one another."""
WAVES = 4
"""Half waves over the log, for what comes and goes slowly."""
_AXES = "xyz"


@dataclass(frozen=True)
class Site:
    """Site of a probe.

    Attributes:
        name: for people.
        channels: residual channels that it moves, with how often the signal is integrated before it shows there.
        group: sites that cannot be distinguished from afar; only the best of a group counts.
    """

    name: str
    channels: tuple[tuple[int, int], ...]
    group: str


@dataclass(frozen=True)
class Follows:
    """Signals that the residual follows at one site.

    Attributes:
        site: where.
        gain: deviance that all signals together take away on unseen blocks.
        alone: what every signal alone takes away, chi-square with one degree of freedom.
    """

    site: Site
    gain: Gain
    alone: Mapping[str, float]

    @property
    def signal(self) -> str:
        """The one that does most alone."""
        return max(self.alone, key=lambda name: self.alone[name])

    @property
    def significant(self) -> bool:
        """Checks whether the gain stands above its own error."""
        return self.gain.total > ERRORS * self.gain.error


SITES = tuple(
    site
    for i, axis in enumerate(_AXES)
    for site in (
        Site(f"moment {axis}", ((i, 1), (3 + i, 2)), f"rotation {axis}"),
        Site(f"gyro {axis}", ((i, 0),), f"rotation {axis}"),
        Site(f"attitude {axis}", ((3 + i, 0),), f"rotation {axis}"),
        Site(f"force {axis}", ((6 + i, 0),), f"force {axis}"),
    )
)


def strongest(found: Sequence[Follows]) -> tuple[Follows, ...]:
    """The best site of each group, best first."""
    best: dict[str, Follows] = {}
    for f in sorted(found, key=lambda f: -f.gain.total):
        best.setdefault(f.site.group, f)
    return tuple(best.values())


def follows(shooting: Shooting, model: Model) -> tuple[Follows, ...]:
    """Holds what `model` leaves against all signals at every site."""
    parts = list(shooting.columns(model.theta, model.free, model.states))
    named = [signals(part) for part in parts]
    names = tuple(named[0])
    # Scaled over all windows alike, so that one coefficient means the same in each.
    stacked = [np.stack(list(s.values()), axis=-1) for s in named]
    scale = np.sqrt(np.mean(np.concatenate([np.mean(s**2, axis=(1,)) for s in stacked]), axis=0))
    stacked = [s / np.where(scale > 0.0, scale, 1.0) for s in stacked]
    prepared = [_prepared(p, s) for p, s in zip(parts, stacked, strict=True)]
    return tuple(_followed(site, names, prepared, model) for site in SITES)


@dataclass(frozen=True)
class _Prepared:
    """Data that all sites of one window share.

    Attributes:
        part: its segments.
        integrated: signals (segments, length, n), as they are, integrated once and twice.
        beside: parameters and, last, the residual, less what initial states take up, shape (segments, length, channels,
            P + 1).
        own: products of the parameters with these, (segments, P, P + 1).
    """

    part: Columns
    integrated: tuple[FloatArray, FloatArray, FloatArray]
    beside: FloatArray
    own: FloatArray


def _prepared(part: Columns, signal: FloatArray) -> _Prepared:
    once = part.window.dt * np.cumsum(signal, axis=1)
    rows = np.concatenate([part.parameters, part.residual.reshape(len(signal), -1, 1)], axis=2)
    rows = rows - part.basis @ (_t(part.basis) @ rows)
    integrated = (signal, once, part.window.dt * np.cumsum(once, axis=1))
    return _Prepared(part, integrated, rows.reshape(*part.residual.shape, -1), _t(rows[..., :-1]) @ rows)


def _followed(site: Site, names: tuple[str, ...], prepared: list[_Prepared], model: Model) -> Follows:
    pieces = [_products(site, p) for p in prepared]
    gram, grad = (np.concatenate([p[i] for p in pieces]) for i in (0, 1))
    own = model.lin.gram.shape[1]
    total, slope = gram.sum(axis=0), grad.sum(axis=0)
    sizes = np.diag(total)[own:]
    precision = np.concatenate([model.prior.precision, RIDGE * sizes + 1e-9])
    both = replace(model.lin, gram=gram, grad=grad)
    none = replace(model.lin, gram=gram[:, :own, :own], grad=grad[:, :own])
    gain = paired_gain(held_out(none, precision[:own]).block, held_out(both, precision).block)
    each = freed(
        (sizes + precision[own:])[:, None, None],
        total[own:, None, :own],
        total[:own, :own] + np.diag(precision[:own]),
        slope[own:, None],
        slope[:own],
    )
    return Follows(site, gain, dict(zip(names, each.tolist(), strict=True)))


def _products(site: Site, p: _Prepared) -> tuple[FloatArray, FloatArray]:
    """Products of parameters and probes of each segment, initial states eliminated: gram and gradient."""
    count, length, n = p.integrated[0].shape
    moved = [c for c, _ in site.channels]
    each = [p.part.whiten(p.integrated[order], channel) for channel, order in site.channels]
    x = np.stack(each, axis=2).reshape(count, -1, n)
    basis = p.part.basis.reshape(*p.beside.shape[:3], -1)[:, :, moved].reshape(count, x.shape[1], -1)
    inside = _t(basis) @ x
    cross = _t(x) @ p.beside[:, :, moved].reshape(count, x.shape[1], -1)
    probes = _t(x) @ x - _t(inside) @ inside
    gram = np.block([[p.own[..., :-1], _t(cross[..., :-1])], [cross[..., :-1], probes]])
    return gram, np.concatenate([p.own[..., -1], cross[..., -1]], axis=1)


def _t(a: FloatArray) -> FloatArray:
    return a.transpose(0, 2, 1)


def signals(part: Columns) -> dict[str, FloatArray]:
    """Signals at the samples of every segment, each of shape (segments, length), not yet scaled.

    Args:
        part: one window's segments with their prediction.
    """
    window = part.window
    rates, force = (_predicted(part, values, channel) for values, channel in ((window.gyro, 0), (window.accel, 6)))
    turned = None
    if window.attitude is not None:
        # The predicted attitude is the measured one turned by its residual, a body rotation.
        error = 0.5 * part.base[:, :, 3:6].reshape(-1, 3)
        turned = product(
            np.nan_to_num(window.attitude[part.rows.ravel()]), np.column_stack([np.ones(len(error)), error])
        ).reshape(*part.rows.shape, 4)
    out = {f"{name} input": s[part.rows - 1] for name, s in inputs(window).items()}
    return out | motions(rates, _before(force), turned) | {name: s[part.rows] for name, s in slow(window).items()}


def slow(window: Window) -> dict[str, FloatArray]:
    """Functions of time that come and go slowly, by row of the window."""
    first, last = window.log_span
    share = (window.t - first) / max(last - first, window.dt)
    waves = {f"time, {n} half waves": np.cos(n * np.pi * share) for n in range(1, WAVES + 1)}
    return {"constant": np.ones_like(share)} | waves


def inputs(window: Window) -> dict[str, FloatArray]:
    """Rotor commands, by row of the window: thrust and differences of squared speeds, their shapes."""
    square = window.rotor_speed**2
    mean = square.mean(axis=1)
    # Principal differences between rotors stand for the moments, whatever the geometry.
    apart = square - mean[:, None]
    apart = apart - apart.mean(axis=0)
    axes = np.linalg.svd(apart, full_matrices=False)[2][: min(3, square.shape[1] - 1)]
    level = float(mean.mean())
    thrust = mean / level - 1.0
    basic = {"thrust": thrust}
    for i, axis in enumerate(axes):
        basic[f"moment {i + 1}"] = apart @ axis / level
    out = dict(basic)
    for name, s in basic.items():
        change = np.diff(s, prepend=s[0])
        out[f"changing {name}"] = change
        out[f"|changing {name}|"] = np.abs(change)
        out[f"squared {name}"] = s**2
        out[f"cubed {name}"] = s**3
    return out


def motions(rates: FloatArray, force: FloatArray | None, attitude: FloatArray | None) -> dict[str, FloatArray]:
    """Rates, tilt and specific force, and products of them, from arrays (..., 3), (..., 3) and (..., 4)."""
    p, q, r = np.moveaxis(rates, -1, 0)
    out = {"p": p, "q": q, "r": r, "p|p|": p * np.abs(p), "q|q|": q * np.abs(q), "r|r|": r * np.abs(r)}
    out |= {"p q": p * q, "q r": q * r, "r p": r * p, "|p|": np.abs(p), "|q|": np.abs(q)}
    if force is not None:
        f_x, f_y, f_z = np.moveaxis(force, -1, 0)
        lift = f_z - np.mean(f_z)
        out |= {"a_x": f_x, "a_y": f_y, "a_z": lift, "a_z squared": lift**2}
        out |= {"a_x a_z": f_x * lift, "a_y a_z": f_y * lift}
    if attitude is not None:
        w, x, y, z = np.moveaxis(attitude, -1, 0)
        out |= {"pitched": 2.0 * (x * z - w * y), "rolled": 2.0 * (y * z + w * x)}
        out |= {"heading north": w * w + x * x - y * y - z * z, "heading east": 2.0 * (x * y + w * z)}
    return out


def _before(signal: FloatArray) -> FloatArray:
    """The signal (segments, length, ...) one step before; at the first sample of a segment, there."""
    return np.concatenate([signal[:, :1], signal[:, :-1]], axis=1)


def _predicted(part: Columns, measured: FloatArray | None, channel: int) -> FloatArray:
    """Predicted values of three channels from one on; where nothing was measured, 0, as their residual."""
    value = part.base[:, :, channel : channel + 3]
    return value if measured is None else value + np.nan_to_num(measured[part.rows])


# --- What remains after the named causes: is it noise, and does it contradict them?
#
# Two looks: does the residual follow anything the vehicle did (`follows`), and does its power stand above
# the noise?  For the second, the whitened residual of each segment, initial state eliminated, is taken apart into
# cosine modes.  Pure noise leaves every mode with the power that the elimination itself leaves it, which is computed
# with the same projection on drawn noise.  Modes that stand above the noise model by more than chance are structure,
# at a frequency, in a channel.  The noise model is that of a flexible fit, flat below 3 Hz, so slow structure cannot
# hide in it.


ALARM = 5.0
"""Standard errors above the floor that count as structure; calibrated on flights without effects."""
CHANGES = ("time", "thrust", "squared thrust", "cubed thrust", "a_x", "a_y", "a_z")
"""First words of the names of signals that an offset may follow: warming up, vibration, acceleration."""
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
    """Rest by channel of the residual and by what it follows.

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
        out.append(_structure(CHANNEL_NAMES[c], found[c], null[c], segments[c], rate))
    return Remainder(tuple(out), follows(shooting, model), model.rows)


def _structure(name: str, found: FloatArray, null: FloatArray, segments: int, rate: float) -> Structure:
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


def inconstant_causes(model: Named, sites: Sequence[Follows]) -> dict[str, str]:
    """Offsets in `model` that are not constant, and what they follow, by label.

    A bias is constant.  Anything whose mean is not zero looks like one at first: a gyro that senses acceleration, warms
    up or is shaken.  The difference is small beside the mean: the rest at the same sensor follows acceleration,
    thrust or time.  A test of all generic signals together is too blunt for that; each alone is not.
    """
    reasons = {c.label: _inconstant(model, c, sites) for c in model.causes}
    return {label: reason for label, reason in reasons.items() if reason}


def _inconstant(model: Named, cause: Candidate, sites: Sequence[Follows]) -> str:
    """Signal that an offset that is not constant follows; empty where it follows nothing, or claims no constancy."""
    kind = EFFECTS[cause.effect].constant_on
    if not kind:
        return ""
    least = max(ALARM**2, CHANGE_SHARE * model.wald(cause))
    followed = [
        (chi_square, f.site.name, signal)
        for f in sites
        if f.site.name.startswith(kind)
        for signal, chi_square in f.alone.items()
        # Of sites that look alike from afar the best counts.
        if signal.startswith(CHANGES)
        and chi_square >= max(g.alone[signal] for g in sites if g.site.group == f.site.group)
    ]
    chi_square, site, signal = max(followed, default=(0.0, "", ""))
    return f"{cause.effect} is not constant (what remains at {site} follows {signal})" if chi_square > least else ""
