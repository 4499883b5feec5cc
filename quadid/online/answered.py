"""Whether an answer can be one to its request: a fit may come from another machine, and is taken in by arithmetic.

Shapes, finite numbers and the time it stands for are those that the request implies; what is left to believe is the
estimate itself, which the gate judges.
"""

from __future__ import annotations

from collections.abc import Container
from typing import TYPE_CHECKING

import numpy as np

from quadid.identify.noise_model import SHAPE_POINTS, NoiseModel
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.window import Window

if TYPE_CHECKING:
    from quadid.online.fusion import WindowEstimate
    from quadid.online.window_fit import FitReply, FitRequest

ROOM = 2.0
"""An estimate may lie so far outside the bounds, log scale: b at hover is not the b that was bounded."""
_SIX = len(NOMINAL_NAMES)


def answers(request: FitRequest, reply: FitReply) -> bool:
    """Whether a reply has the form of an answer to this request."""
    channels = {min((_channels(w) for w in request.windows), default=0)}
    if request.noise is not None:
        channels.add(len(request.noise.white))
    no_numbers = reply.estimate is not None and not reply.estimate.finite
    return (
        all(a is None or a.shape == (_SIX,) for a in (reply.excitation, reply.misfit, reply.between_rows))
        and all(n is None or _is_noise(n, channels) for n in (reply.noise, reply.measured))
        and (reply.theta is None or _is_vector(reply.theta, request.theta, no_numbers))
        and (reply.estimate is None or _is_estimate(reply.estimate, request))
    )


def _channels(window: Window) -> int:
    if window.position is not None:
        return 15
    return 9 if window.velocity is None else 12


def _is_noise(noise: NoiseModel, channels: Container[int]) -> bool:
    shape = noise.white.shape
    if len(shape) != 1 or shape[0] not in channels or noise.slow.shape != shape or not noise.slow_time > 0.0:
        return False
    return noise.shape is None or noise.shape.shape == (*shape, SHAPE_POINTS)


def _is_vector(theta: FloatArray, asked: FloatArray, no_numbers: bool) -> bool:
    """Finite and possible, but where the estimate is told to be no numbers: then nothing of it is taken in."""
    possible = bool(np.isfinite(theta).all() and np.all(theta[:_SIX] > 0.0))
    return theta.shape == asked.shape and (possible or no_numbers)


def _is_estimate(estimate: WindowEstimate, request: FitRequest) -> bool:
    """One that is no numbers is told as such later."""
    shapes = (estimate.z.shape, estimate.score.shape, estimate.information.shape)
    if shapes != ((_SIX,), (_SIX,), (_SIX, _SIX)) or (estimate.start, estimate.stop) != (request.start, request.stop):
        return False
    if not estimate.finite:
        return True
    entries = [Layout(request.vehicle).entry(name) for name in NOMINAL_NAMES]
    low, high = (np.log([getattr(e, side) for e in entries]) for side in ("lower", "upper"))
    if np.any(estimate.z < low - ROOM) or np.any(estimate.z > high + ROOM):
        return False
    values = np.linalg.eigvalsh(0.5 * (estimate.information + estimate.information.T))
    return bool(values[0] >= -1e-9 * max(values[-1], 1.0))
