"""Rate and attitude loops about hover, linear, axis by axis: margins, step responses, and gains for a wanted margin.

    L(s) = C(s) E(s) A M(s) e^(-T s) G(s) / (s + n)      rate loop, opened at the rate error
    C(s) = p + i / s + d s / (1 + s / w_d)               p [1/s], i [1/s^2], d [-]: per unit of angular acceleration
    M(s) = (1 + lead s) / (1 + tau s)                    rotors; lead: their spin-up, in yaw
    G(s) = Butterworth, second order, of the gyro;  E(s) = first-order low-pass of the rate error
    F(s) = first-order low-pass of the rate asked for, outside the loop
    T    = delay of the command + half a period of the loop, which holds its output

A is the angular acceleration that a unit brings, over what it is believed to bring: 1 for the vehicle as identified.
The attitude loop asks for the rate a times the error of the angle.  n is the damping by the air.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.errors import ParameterError
from quadid.types import FloatArray

ComplexArray = NDArray[np.complex128]
INTEGRAL = 8.0
"""The integral takes over this far below the crossover: it costs atan(1/8), 7 degrees."""
NOISY = 3.0
"""Largest gain of the derivative beside the proportional part, for the noise of the gyro."""
GAIN_MARGIN = 6.0
"""Least gain margin [dB]."""
ATTITUDE_MARGIN = 65.0
"""Least phase margin of the attitude loop [deg]: an angle should hardly overshoot."""
_HZ = np.geomspace(0.02, 500.0, 1500)
_GAINS = (0.05, 500.0)
"""Rate gains [1/s] among which the largest is looked for."""
_FINE, _WIDE, _SECONDS = 200.0, 60.0, 300
"""A step response is an integral over frequencies up to `_WIDE` bandwidths in steps of a bandwidth over `_FINE`."""


class RateGains(NamedTuple):
    """Gains of one rate loop, as angular acceleration; `cutoff` [Hz] is that of the derivative's low-pass."""

    p: float
    i: float
    d: float = 0.0
    cutoff: float = math.inf


@dataclass(frozen=True)
class AxisPlant:
    """Chain between the output of a rate controller and the rate it reads, for one axis.

    Attributes:
        gain: A, shape (variants,); the first variant is the nominal one, here as below.
        lag: time constant of the rotors [s], shape (variants,).
        delay: T [s], shape (variants,).
        lead: of the rotors' spin-up [s].
        cutoff: of the gyro's filter [Hz]; infinite for none.
        error: cut-off of a filter of the rate error [Hz]; infinite for none.
        target: cut-off of a filter of the rate asked for [Hz]; infinite for none.
        damping: of the rate by the air [1/s].
    """

    gain: FloatArray
    lag: FloatArray
    delay: FloatArray
    lead: float = 0.0
    cutoff: float = math.inf
    error: float = math.inf
    target: float = math.inf
    damping: float = 0.0

    def response(self, s: ComplexArray) -> ComplexArray:
        """From the error of the rate, by a gain of one, to the true rate, shape (variants, n)."""
        rotors = (1.0 + self.lead * s) / (1.0 + self.lag[:, None] * s) / (1.0 + s / (2.0 * math.pi * self.error))
        return np.asarray(self.gain[:, None] * rotors * np.exp(-self.delay[:, None] * s) / (s + self.damping))

    def read(self, s: ComplexArray) -> ComplexArray:
        """From the true rate to what the controller reads, shape (n,)."""
        u = s / (2.0 * math.pi * self.cutoff)
        return np.asarray(1.0 / (1.0 + math.sqrt(2.0) * u + u * u))

    def phases(self, hz: float, gains: RateGains) -> dict[str, float]:
        """Phase that each part of the loop takes at a frequency [deg]; negative: it gives."""
        w = 2.0 * math.pi * hz
        s = np.array([1j * w])
        parts = {
            "delay": -self.delay[0] * w,
            "motor lag": float(np.angle((1 + self.lead * s[0]) / (1 + self.lag[0] * s[0]))),
            "gyro filter": float(np.angle(self.read(s)[0])),
            "error filter": -math.atan(hz / self.error),
            "controller": float(np.angle(controller(gains, s)[0])),
        }
        return {name: -math.degrees(angle) for name, angle in parts.items()}


def controller(gains: RateGains, s: ComplexArray, on_error: bool = True) -> ComplexArray:
    """C(s); without the derivative where that acts on the measured rate only (`on_error` False)."""
    derivative = gains.d * s / (1.0 + s / (2.0 * math.pi * gains.cutoff)) if on_error else 0.0
    return np.asarray(gains.p + gains.i / s + derivative)


class Margins(NamedTuple):
    """Margins of every variant: phase [deg], gain [dB], crossover [Hz], shape (variants,) each.

    Unstable loops have a negative phase margin.
    """

    phase: FloatArray
    gain: FloatArray
    crossover: FloatArray

    def keep(self, phase: float) -> bool:
        """True where every variant keeps this phase margin [deg] and `GAIN_MARGIN`."""
        return bool(self.phase.min() >= phase and self.gain.min() >= GAIN_MARGIN)


def margins(loop: ComplexArray) -> Margins:
    """Margins of open loops at the frequencies `_HZ`, shape (variants, n)."""
    size, phase = np.abs(loop), np.unwrap(np.angle(loop), axis=1)
    out = np.empty((3, len(loop)))
    for k in range(len(loop)):
        above = np.flatnonzero(size[k] >= 1.0)
        at = above[-1] if len(above) else 0
        at = min(at, len(_HZ) - 2)
        part = np.log(size[k, at]) / np.log(size[k, at] / size[k, at + 1]) if len(above) else 0.0
        out[0, k] = 180.0 + np.degrees(phase[k, at] + part * (phase[k, at + 1] - phase[k, at]))
        turned = np.flatnonzero((phase[k, :-1] > -np.pi) & (phase[k, 1:] <= -np.pi))
        out[1, k] = -20.0 * np.log10(size[k, turned].max()) if len(turned) else np.inf
        out[2, k] = _HZ[at] * (_HZ[at + 1] / _HZ[at]) ** part
    return Margins(*out)


_S: ComplexArray = np.asarray(2j * np.pi * _HZ, dtype=np.complex128)


class Loops:
    """Rate and attitude loop of one axis with given gains.

    Attributes:
        plant: what is controlled.
        rate: gains of the rate loop.
        attitude: gain of the attitude loop [1/s]; 0 for none.
    """

    def __init__(self, plant: AxisPlant, rate: RateGains, attitude: float, on_error: bool) -> None:
        self.plant, self.rate, self.attitude, self._on_error = plant, rate, attitude, on_error

    def closed(self, s: ComplexArray, angle: bool = False) -> ComplexArray:
        """From what is asked for to what comes, the rate or the angle, shape (variants, n)."""
        plant = self.plant.response(s)
        around = controller(self.rate, s) * plant * self.plant.read(s)
        asked = 1.0 / (1.0 + s / (2.0 * math.pi * self.plant.target))
        rate = asked * controller(self.rate, s, self._on_error) * plant / (1.0 + around)
        around = self.attitude * rate / s
        return np.asarray(around / (1.0 + around) if angle else rate)

    def margins(self, angle: bool = False) -> Margins:
        """Margins of the rate loop, or of the attitude loop around it."""
        if angle:
            return margins(np.asarray(self.attitude * self.closed(_S) / _S))
        return margins(np.asarray(controller(self.rate, _S) * self.plant.response(_S) * self.plant.read(_S)))

    @property
    def stable(self) -> bool:
        """Checks whether every variant of both loops is stable."""
        return bool(min(*self.margins().phase, *self.margins().gain) > 0.0) and (
            self.attitude == 0.0 or bool(min(*self.margins(True).phase, *self.margins(True).gain) > 0.0)
        )

    def bandwidth(self, angle: bool = False) -> FloatArray:
        """Frequency at which what comes has fallen by 3 dB for good [Hz], shape (variants,)."""
        size = np.abs(self.closed(_S, angle))
        last = size.shape[1] - 1 - np.argmax(size[:, ::-1] >= math.sqrt(0.5), axis=1)
        return np.asarray(_HZ[last])

    def step(self, angle: bool = False) -> tuple[FloatArray, FloatArray]:
        """Response to a unit step of the rate, or of the angle, asked for.

        Returns:
            Times [s], shape (n,), and what comes, shape (variants, n): exact for stable loops, delays included, from
            the inverse transform (2 / pi) Int Re T(jw) sin(w t) / w dw.
        """
        band = float(self.bandwidth(angle)[0])
        w = 2.0 * np.pi * band * (np.arange(round(_FINE * _WIDE)) + 0.5) / _FINE
        t = np.linspace(0.0, 3.0 / band, _SECONDS)
        real = np.real(self.closed(np.asarray(1j * w), angle)) / w
        return t, np.asarray((2.0 / np.pi) * (w[1] - w[0]) * real @ np.sin(np.outer(w, t)))


def with_rate(plant: AxisPlant, p: float, cutoff: float, derivative: bool) -> RateGains:
    """Gains of one size: the derivative takes the motor lag back, as far as noise allows."""
    d = min(float(plant.lag[0]), NOISY / (2.0 * math.pi * cutoff)) if derivative else 0.0
    return RateGains(p, p * p / INTEGRAL, p * d, cutoff)


def _largest(allowed: Callable[[float], bool], low: float, high: float) -> float:
    """Largest number up to which something is allowed, by halving on the log scale."""
    for _ in range(24):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return low


def design(
    plant: AxisPlant, phase_margin: float, most: float, cutoff: float, derivative: bool, on_error: bool
) -> Loops:
    """The fastest loops with margins that every variant keeps.

    Args:
        plant: nominal and its variants.
        phase_margin: least one of the rate loop [deg].
        most: largest rate gain [1/s] that the rotors' moment allows.
        cutoff: of the derivative's filter [Hz].
        derivative: whether there is one.
        on_error: it acts on the error, not on the rate alone.

    Raises:
        ParameterError: no gain keeps the margin.
    """

    def loops(p: float) -> Loops:
        return Loops(plant, with_rate(plant, p, cutoff, derivative), 0.0, on_error)

    def keeps(p: float) -> bool:
        return loops(p).margins().keep(phase_margin)

    if not keeps(_GAINS[0]):
        raise ParameterError(f"a phase margin of {phase_margin:g} deg", "what the loop can keep", "ask for less")
    return with_attitude(loops(min(_largest(keeps, *_GAINS), most)), phase_margin)


def with_attitude(loops: Loops, phase_margin: float) -> Loops:
    """The same rate loop with the fastest attitude loop that keeps its margins around it."""
    least = max(phase_margin, ATTITUDE_MARGIN)

    def around(a: float) -> Loops:
        return Loops(loops.plant, loops.rate, a, loops._on_error)

    return around(_largest(lambda a: around(a).margins(True).keep(least), 1e-3 * loops.rate.p, loops.rate.p))


def slowed(loops: Loops, bandwidth: float, phase_margin: float, derivative: bool) -> Loops:
    """The same loops with a smaller gain, so that the nominal rate loop has this bandwidth [Hz].

    Raises:
        ParameterError: it cannot be that fast, or not that slow.
    """
    plant, cutoff = loops.plant, loops.rate.cutoff

    def at(p: float) -> Loops:
        return Loops(plant, with_rate(plant, p, cutoff, derivative), 0.0, loops._on_error)

    fastest = float(loops.bandwidth()[0])
    if bandwidth > fastest:
        raise ParameterError(f"a bandwidth of {bandwidth:g} Hz", f"up to {fastest:.3g} Hz", "ask for less")
    p = _largest(lambda p: at(p).bandwidth()[0] <= bandwidth, _GAINS[0], loops.rate.p)
    return with_attitude(at(p), phase_margin)
