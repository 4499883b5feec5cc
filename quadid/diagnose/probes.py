"""What remains, held against generic causes: does the residual follow anything that the vehicle did?

A spectrum sees structure only where it stands above the noise.  Something that follows a command, a motion or the
time is seen far below that.  Each probe is a signal (an input, its square, its past, a predicted motion, a slow
function of time) acting at a site: as a moment, a force, an error of the gyro or of the attitude.  Its whitened
response, less what initial states and free parameters take up, is fitted on all blocks but one and judged on that one,
so a probe that follows only noise loses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.blocks import Gain, block_labels, held_out_deviance, paired_gain
from quadid.diagnose.models import Model
from quadid.diagnose.signals import signals
from quadid.identify.segment_jacobian import Columns
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

ERRORS = 2.5
"""Standard errors of a gain on unseen blocks above which a site counts as structured …"""
LEAST_GAIN = 50.0
"""… and at least this much deviance."""
_RIDGE = 1e-6
"""Prior precision of a probe, relative to its information: keeps signals finite that double one another."""
_AXES = "xyz"


@dataclass(frozen=True)
class Site:
    """Where a probe acts.

    Attributes:
        name: for people.
        axis: 0, 1, 2: body x, y, z.
        channels: residual channels that it moves, with how often the signal is integrated before it shows there.
        group: sites that cannot be told apart from afar; only the best of a group counts.
    """

    name: str
    axis: int
    channels: tuple[tuple[int, int], ...]
    group: str


@dataclass(frozen=True)
class Follows:
    """What the residual follows at one site.

    Attributes:
        site: where.
        gain: deviance that all signals together take away on unseen blocks.
        signal: the one that does most alone.
    """

    site: Site
    gain: Gain
    signal: str

    @property
    def significant(self) -> bool:
        """Whether the gain stands above its own error."""
        return self.gain.total > max(ERRORS * self.gain.error, LEAST_GAIN)


@dataclass(frozen=True)
class Alone:
    """What one signal alone explains at one site: names of both, chi-square with one degree of freedom."""

    site: str
    signal: str
    chi_square: float


def _sites() -> tuple[Site, ...]:
    out = []
    for i, axis in enumerate(_AXES):
        group = f"rotation {axis}"
        out.append(Site(f"moment {axis}", i, ((i, 1), (3 + i, 2)), group))
        out.append(Site(f"gyro {axis}", i, ((i, 0),), group))
        out.append(Site(f"attitude {axis}", i, ((3 + i, 0),), group))
        out.append(Site(f"force {axis}", i, ((6 + i, 0),), f"force {axis}"))
    return tuple(out)


SITES = _sites()


def follows(shooting: Shooting, model: Model) -> tuple[tuple[Follows, ...], tuple[Alone, ...]]:
    """Holds what `model` leaves against all signals at all sites.

    Returns:
        All signals together, at the best site of each group, strongest first; and every signal alone at every site.
    """
    parts = list(shooting.columns(model.theta, model.free, model.states))
    named = [signals(part) for part in parts]
    names = tuple(named[0])
    # Scaled over all windows alike, so that one coefficient means the same in each.
    stacked = [np.stack(list(s.values()), axis=-1) for s in named]
    scale = np.sqrt(np.mean(np.concatenate([np.mean(s**2, axis=(1,)) for s in stacked]), axis=0))
    stacked = [s / np.where(scale > 0.0, scale, 1.0) for s in stacked]
    labels = block_labels(model.lin)
    prepared = [_prepare(p, s) for p, s in zip(parts, stacked, strict=True)]
    best: dict[str, Follows] = {}
    alone: list[Alone] = []
    for site in SITES:
        found, each = _judge(site, names, prepared, model, labels)
        alone += each
        if site.group not in best or found.gain.total > best[site.group].gain.total:
            best[site.group] = found
    return tuple(sorted(best.values(), key=lambda f: -f.gain.total)), tuple(alone)


@dataclass(frozen=True)
class _Prepared:
    """What all sites of one window share.

    Attributes:
        part: its segments.
        integrated: signals (segments, length, n), as they are, integrated once and twice.
        inside: components of parameters and residual along the initial state's directions.
        gram, grad: products of the parameters, initial states eliminated.
    """

    part: Columns
    integrated: tuple[FloatArray, FloatArray, FloatArray]
    inside: tuple[FloatArray, FloatArray]
    gram: FloatArray
    grad: FloatArray


def _prepare(part: Columns, signal: FloatArray) -> _Prepared:
    once = part.window.dt * np.cumsum(signal, axis=1)
    b, r = part.parameters, part.residual.reshape(len(signal), -1, 1)
    ab, ar = _t(part.basis) @ b, _t(part.basis) @ r
    integrated = (signal, once, part.window.dt * np.cumsum(once, axis=1))
    return _Prepared(part, integrated, (ab, ar), _t(b) @ b - _t(ab) @ ab, _t(b) @ r - _t(ab) @ ar)


def _judge(
    site: Site, names: tuple[str, ...], prepared: list[_Prepared], model: Model, labels: NDArray[np.intp]
) -> tuple[Follows, list[Alone]]:
    pieces = [_products(site, p) for p in prepared]
    gram, grad = (np.concatenate([p[i] for p in pieces]) for i in (0, 1))
    own = model.lin.gram.shape[1]
    precision = np.concatenate([1.0 / model.prior.sigma**2, _RIDGE * np.einsum("spp->p", gram)[own:] + 1e-9])
    both = replace(model.lin, gram=gram, grad=grad)
    none = replace(model.lin, gram=gram[:, :own, :own], grad=grad[:, :own])
    gain = paired_gain(held_out_deviance(none, precision[:own], labels), held_out_deviance(both, precision, labels))
    each = _chi_squares(gram.sum(axis=0), grad.sum(axis=0), precision, own)
    alone = [Alone(site.name, n, float(c)) for n, c in zip(names, each, strict=True)]
    return Follows(site, gain, names[int(np.argmax(each))]), alone


def _products(site: Site, p: _Prepared) -> tuple[FloatArray, FloatArray]:
    """Products of parameters and probes of each segment, initial states eliminated: gram and gradient."""
    part, (ab, ar) = p.part, p.inside
    count, length, n = p.integrated[0].shape
    channels = part.residual.shape[2]
    moved = [c for c, _ in site.channels]
    each = [part.whiten(p.integrated[order], channel) for channel, order in site.channels]
    x = np.stack(each, axis=2).reshape(count, -1, n)
    basis = part.basis.reshape(count, length, channels, -1)[:, :, moved].reshape(count, x.shape[1], -1)
    rows = part.parameters.reshape(count, length, channels, -1)[:, :, moved].reshape(count, x.shape[1], -1)
    r = part.residual[:, :, moved].reshape(count, -1, 1)
    ax = _t(basis) @ x
    own = p.gram.shape[1]
    gram = np.empty((count, own + n, own + n))
    gram[:, :own, :own] = p.gram
    gram[:, own:, own:] = _t(x) @ x - _t(ax) @ ax
    gram[:, own:, :own] = _t(x) @ rows - _t(ax) @ ab
    gram[:, :own, own:] = _t(gram[:, own:, :own])
    return gram, np.concatenate([p.grad, _t(x) @ r - _t(ax) @ ar], axis=1)[..., 0]


def _t(a: FloatArray) -> FloatArray:
    return a.transpose(0, 2, 1)


def _chi_squares(gram: FloatArray, grad: FloatArray, precision: FloatArray, own: int) -> FloatArray:
    """How much each probe alone lowers the deviance, the model's own parameters refitted."""
    h_oo = gram[:own, :own] + np.diag(precision[:own])
    solved = np.linalg.solve(h_oo, np.column_stack([gram[:own, own:], grad[:own]]))
    s = np.diag(gram[own:, own:]) - np.sum(gram[:own, own:] * solved[:, :-1], axis=0)
    g = grad[own:] - gram[own:, :own] @ solved[:, -1]
    informed = s > 1e-6 * np.diag(gram[own:, own:])
    return np.asarray(np.where(informed, g * g / np.maximum(s, 1e-12), 0.0))
