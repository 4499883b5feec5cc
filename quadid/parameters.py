"""Identified parameters: names, units, values, bounds, covariance and status."""

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from quadid.chi_square import Z95
from quadid.errors import ParameterError, nearest
from quadid.types import FloatArray


class Status(StrEnum):
    """Status of one parameter: what the data determine."""

    IDENTIFIED = "identified"
    RATIO_ONLY = "ratio_only"
    PRIOR_DOMINATED = "prior_dominated"
    UNRELIABLE = "unreliable"


UNKNOWN = frozenset({Status.PRIOR_DOMINATED, Status.UNRELIABLE})
"""Statuses of numbers that are not to be used as measured."""
PRIOR_SHARE = 0.5
"""A parameter whose posterior is wider than this share of its prior is prior-dominated."""
AT_BOUND = 1e-3
"""Distance from a bound, relative to it, within which a value rests on it: what stands there is the bound, not data."""


FLOOR = 0.1
"""Least relative standard deviation with which vehicles are drawn in a parameter that no flight has shown."""


def at_bound(value: float, low: float, high: float) -> bool:
    """Checks whether `value` rests on one of its bounds; a bound of zero has the scale of the other one."""
    scale = (abs(low) or abs(high), abs(high) or abs(low))
    return value <= low + AT_BOUND * scale[0] or value >= high - AT_BOUND * scale[1]


NOMINAL_UNITS: dict[str, str] = {
    "b": "N s^2/rad^2",
    "d": "N m s^2/rad^2",
    "J_xx": "kg m^2",
    "J_yy": "kg m^2",
    "J_zz": "kg m^2",
    "J_r": "kg m^2",
}
"""The paper's identified vector Theta: thrust and drag coefficient, body inertias, rotor inertia; with SI units."""
NOMINAL_NAMES: tuple[str, ...] = tuple(NOMINAL_UNITS)
TANGENT = "b_tangent"
"""Beside the six where a thrust curve was fitted along: thrust changes with speed at hover as by b w^2 with this b."""
MAY_VANISH = "J_r"
"""Light rotors hardly turn the vehicle, and simulators leave their inertia out: this may be as good as nothing."""
VANISHED = 1e-3
"""Share of its guess at which such a parameter is as good as nothing."""


@dataclass(frozen=True)
class Parameter:
    """One identified number.

    Attributes:
        name: paper's symbol, or ``effect.parameter`` for an effect.
        unit: SI unit.
        value: estimate.
        sigma: standard deviation of the estimate, same unit; NaN when unknown.
        initial: value the fit started from.
        bounds: allowed interval.
        status: what the data determine of it.
        relative_to: for `ratio_only`, the parameter whose ratio to this one is known.
        ci95: 95 % interval; derived from `sigma` by the fit, which may use the log scale.
        prior_share: share of what is known about it that was known before the flight, 0 to 1; NaN when unknown.
        measured_before: what was known is sharper than its bounds: a `sigma` of the vehicle file, or a thrust stand.
    """

    name: str
    unit: str
    value: float
    sigma: float = math.nan
    initial: float = math.nan
    bounds: tuple[float, float] = (-math.inf, math.inf)
    status: Status = Status.IDENTIFIED
    relative_to: str | None = None
    ci95: tuple[float, float] = (math.nan, math.nan)
    prior_share: float = math.nan
    measured_before: bool = False


def unreliable(parameters: Iterable[Parameter], names: Collection[str]) -> tuple[Parameter, ...]:
    """Parameters, with the identified ones of `names` marked unreliable."""
    return tuple(
        replace(p, status=Status.UNRELIABLE, relative_to=None) if p.name in names and p.status not in UNKNOWN else p
        for p in parameters
    )


def _scaled(p: Parameter, factor: float, sigma: float) -> Parameter:
    """A parameter times a factor whose logarithm has this standard deviation."""
    value = p.value * factor
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # ends of an interval may be 0 and infinite
        away = np.hypot(np.log(p.ci95) - np.log(p.value), Z95 * sigma)
        low, high = (value * np.exp(away * [-1.0, 1.0])).tolist()
    return replace(p, value=value, sigma=factor * math.hypot(p.sigma, sigma * p.value), ci95=(low, high))


@dataclass(frozen=True)
class ParameterSet:
    """Parameters with their joint covariance.

    Attributes:
        parameters: the numbers, in vector order.
        covariance: shape (n, n), in the parameters' own units.
    """

    parameters: tuple[Parameter, ...]
    covariance: FloatArray

    def __post_init__(self) -> None:
        """Checks shapes; raises ParameterError."""
        n = len(self.parameters)
        if self.covariance.shape != (n, n):
            raise ParameterError(f"covariance of shape {self.covariance.shape}", f"shape ({n}, {n})")
        self.covariance.setflags(write=False)

    def unreliable(self, names: Sequence[str]) -> "ParameterSet":
        """The same, with the identified ones of `names` marked unreliable."""
        return ParameterSet(unreliable(self.parameters, names), np.array(self.covariance))

    def scaled_together(self, sigma: float, factor: float = 1.0, but: Collection[str] = ()) -> "ParameterSet":
        """The same times one factor, known to `sigma` (log scale), on all that the data determine but those named."""
        fixed = [p.status is Status.PRIOR_DOMINATED or p.name in but for p in self.parameters]
        scaled = (p if stays else _scaled(p, factor, sigma) for p, stays in zip(self.parameters, fixed, strict=True))
        scale, values = np.where(fixed, 1.0, factor), np.where(fixed, 0.0, factor * self.values)
        covariance = self.covariance * np.outer(scale, scale) + sigma**2 * np.outer(values, values)
        return ParameterSet(tuple(scaled), covariance)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in vector order."""
        return tuple(p.name for p in self.parameters)

    @property
    def values(self) -> FloatArray:
        """Values in vector order, shape (n,)."""
        return np.array([p.value for p in self.parameters])

    @property
    def correlation(self) -> FloatArray:
        """Correlation of the estimates, shape (n, n); zero beside what has no spread."""
        sigma = np.sqrt(np.diag(self.covariance))
        scale = np.where(sigma > 0.0, sigma, np.inf)
        return np.asarray(self.covariance / np.outer(scale, scale))

    def sample(self, n: int, seed: int = 0, floor: float = FLOOR) -> tuple[FloatArray, dict[str, str]]:
        """Draws parameter values from the joint covariance, as logarithms, so that none changes its sign.

        A parameter that this flight did not identify has at least the spread `floor`: what was not measured is never
        drawn with no width.

        Args:
            floor: least relative standard deviation of a parameter that is not identified.

        Returns:
            Values, shape (n, parameters); names with the reason of those whose spread is the floor.

        Raises:
            ParameterError: fewer than one draw, a floor that is not positive, or a value that is not positive.
        """
        if n < 1 or not floor > 0.0:
            raise ParameterError(f"{n} draws with a floor of {floor}", "1 or more, a positive floor")
        if not np.all(self.values > 0.0):
            raise ParameterError("a value that is not positive has no logarithm", "positive parameters")
        shape = self.covariance / np.outer(self.values, self.values)
        sigma = np.sqrt(np.diag(shape))
        floors = {
            p.name: f"{p.status.value}: not measured, drawn with {floor:.0%}"
            for p, s in zip(self.parameters, sigma, strict=True)
            if not s > 0.0 or (p.status is not Status.IDENTIFIED and s < floor)
        }
        for i, name in enumerate(self.names):
            if name in floors:
                shape[i, :] = shape[:, i] = 0.0
                shape[i, i] = floor**2
        draws = np.random.default_rng(seed).multivariate_normal(np.zeros(len(self)), shape, size=n, method="eigh")
        return self.values * np.exp(draws), floors

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        """Returns the parameter called `name`; raises ParameterError with the nearest valid name."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise ParameterError(f"unknown parameter '{name}'", fix=nearest(name, self.names))


INERTIAS = ("J_xx", "J_yy", "J_zz")
"""Principal moments of inertia."""
INERTIA_SLACK = 3.0
"""Largest breach of the triangle inequality.  The paper's own Table 2 breaks it by 24 % (J_zz = 0.0292 against
J_xx + J_yy = 0.0236) and a first guess may be off by half, so only a breach beyond any such guess is a wrong file."""


def impossible_inertia(diagonal: Sequence[float], slack: float = INERTIA_SLACK) -> str | None:
    """Says why principal moments of inertia cannot belong to a rigid body, or returns None.

    Each must be positive and none may exceed the sum of the other two (triangle inequality) by more than `slack`.

    Args:
        diagonal: J_xx, J_yy, J_zz [kg m^2].
        slack: factor by which the inequality may be broken; 1 for none.
    """
    for name, value in zip(INERTIAS, diagonal, strict=True):
        if not value > 0.0:
            return f"{name} = {value:g} kg m^2 is not positive"
    for i, name in enumerate(INERTIAS):
        others = sum(diagonal) - diagonal[i]
        if diagonal[i] > slack * others:
            return f"{name} = {diagonal[i]:g} kg m^2 breaks the triangle inequality: the other two sum to {others:g}"
    return None
