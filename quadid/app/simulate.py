"""Simulated flights: the closed-loop vehicle flown and logged, with effects that the model does not have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.app.identify import check_seed
from quadid.app.logs import write_recording
from quadid.app.options import key_numbers
from quadid.app.outcome import Outcome
from quadid.effects import EFFECTS
from quadid.errors import ParameterError, QuadidError, nearest
from quadid.files import read_regular
from quadid.parameters import NOMINAL_UNITS, Parameter, ParameterSet, Status
from quadid.report.tables import Cell
from quadid.rotation import down
from quadid.vehicle import ParameterPrior, Vehicle
from quadid.yaml_text import read_value

if TYPE_CHECKING:
    from quadid.flight import Flight, Segment

SUFFIXES = (".mcap", ".tlog", ".csv")
LONGEST = 3600.0
"""Longest flight [s]: every step of it is held in memory."""
WIDEST = 0.9
"""Largest fraction by which true parameters leave those of the type."""


MOST_DRAWS = 1000
"""Vehicles of one call."""


class SimulateError(QuadidError):
    """A flight that cannot be flown or written as asked."""


@dataclass(frozen=True, repr=False)
class Simulated(Outcome):
    """A simulated flight; `result` has the form ``quadid.simulate/1``, its ``log`` None until written."""

    rows = "parameters"
    result: dict[str, Any]
    flight: Flight

    def save(self, path: str | Path) -> Path:
        """Writes the log, as MCAP, tlog or CSV by suffix; returns its absolute path."""
        check_suffix(path)
        return write_recording(path, self.flight.recording)

    @property
    def opening(self) -> list[Cell]:
        """Flight, and where it was logged."""
        r, log = self.result, f" and logged to {self.result['log']}" if self.result["log"] else ""
        return [Cell(f"{r['vehicle']}: {r['rows']} rows at {r['rows'] / r['seconds']:.4g} Hz flown{log}")]

    def __repr__(self) -> str:
        r, effects = self.result, ", ".join(self.result["effects"]) or "none"
        return f"{r['vehicle']}: {r['rows']} rows, {r['seconds']:.1f} s flown; effects: {effects}"


@dataclass(frozen=True, repr=False)
class Drawn(Outcome):
    """Several vehicles flown; `result` has the form ``quadid.simulate/1`` with ``draws``, whose files have `names`."""

    result: dict[str, Any]
    names: tuple[str, ...]

    @property
    def opening(self) -> list[Cell]:
        """A line a vehicle."""
        told = [f"diverged, {d['diverged']}" if d["diverged"] else "flown" for d in self.result["draws"]]
        return [Cell(f"{name}: {what}") for name, what in zip(self.names, told, strict=True)]

    @property
    def failure(self) -> Exception | None:
        """The error where no vehicle lasted."""
        from quadid.flight import FlightError

        if any(not d["diverged"] for d in self.result["draws"]):
            return None
        fix = "another manoeuvre, or gains that fit the vehicle"
        return FlightError(f"all {len(self.names)} vehicles diverged", fix=fix)


def simulate(
    vehicle: str | Path | Vehicle = "pelican",
    *,
    seconds: float = 500.0,
    seed: int = 1,
    effects: Sequence[str] = (),
    profile: str = "excited",
    manoeuvre: str | Path | None = None,
    noise: float = 1.0,
    rate: float = 50.0,
    extras: Sequence[str] = (),
    spread: float = 0.0,
    random: bool = False,
) -> Simulated:
    """Flies the closed-loop vehicle, controlled at 1 kHz, and logs it.

    Args:
        vehicle: a shipped name, a YAML file or a `Vehicle`, whose values are the truth.
        seconds: length of the flight [s].
        seed: of all random numbers.
        effects: hidden effects, as ``rotor_drag:k_x=0.3,k_y=0.3``; without values drawn at a realistic size.
        profile: what the pilot does: excited, gentle, hover, one_axis, roll_pitch.
        manoeuvre: YAML file of segments to fly instead.
        noise: scales all sensor noise.
        rate: of the log [Hz].
        extras: velocity, position or battery are logged as well.
        spread: true parameters are drawn within this fraction of the type.
        random: the vehicle's random forces act, too.

    Raises:
        SimulateError: a length or a manoeuvre that cannot be flown.
        ParameterError: unknown effects or values.
        FlightError: the vehicle ends on the ground.
    """
    from quadid.flight import TruthParameters, draw_truth, fly

    if not (math.isfinite(seconds) and 0.0 < seconds <= LONGEST):
        raise SimulateError(f"a flight of {seconds:g} s", f"more than 0 and at most {LONGEST:g} s")
    if not (math.isfinite(noise) and noise >= 0.0):
        raise ParameterError(f"noise {noise:g}", "a factor from 0 on")
    if not 0.0 <= spread <= WIDEST:
        raise ParameterError(f"spread {spread:g}", f"a fraction from 0 to {WIDEST:g}")
    check_seed(seed)
    described = Vehicle.named(vehicle)
    truth = draw_truth(described, seed, spread) if spread > 0.0 else TruthParameters.of(described)
    named, outside = parse_effects(effects, described, seed, seconds)
    segments = read_manoeuvre(Path(manoeuvre)) if manoeuvre is not None else None
    flown = profile if segments is None else "scripted"
    flight = fly(
        described,
        truth,
        seconds,
        seed,
        flown,
        effects={**described.effects, **named},
        outside=outside,
        noise_scale=noise,
        log_rate=rate,
        segments=segments,
        extras=extras,
        random=described.random if random else None,
    )
    result = summary(flight, seed, flown)
    if described.residual:
        terms = "; ".join(term.formula for term in described.residual)
        result["warnings"] = [f"residual terms are no part of the flown vehicle: {terms}"]
    return Simulated(result, flight)


@dataclass(frozen=True)
class Draw:
    """One of several vehicles that a vehicle file may stand for.

    Attributes:
        flown: its flight; None where it did not last.
        failed: why it did not last; empty where it did.
    """

    seed: int
    vehicle: Vehicle
    flown: Simulated | None
    failed: str = ""

    @property
    def entry(self) -> dict[str, Any]:
        """One draw of ``quadid.simulate/1``; its ``log`` is None until written."""
        values = {name: prior.initial for name, prior in self.vehicle.parameters.items()}
        head = {"seed": self.seed, "diverged": self.failed or None}
        return {**({"log": None, "parameters": values} if self.flown is None else self.flown.result), **head}


def simulate_draws(vehicle: str | Path | Vehicle, draws: int, seed: int = 1, **how: Any) -> list[Draw]:
    """Flies several vehicles that the file may stand for, each under random forces of its own.

    Values are drawn from the file's standard deviations, those without one with the floor of `ParameterSet.sample`.

    Args:
        vehicle: as `simulate`.
        draws: number of vehicles.
        seed: decides the values; the flights have this and the following seeds.
        how: further arguments of `simulate`.

    Raises:
        ParameterError: an impossible number of draws; else as `simulate`, but for vehicles that do not last.
    """
    from quadid.flight import FlightError

    if not 1 <= draws <= MOST_DRAWS:
        raise ParameterError(f"{draws} draws", f"1 to {MOST_DRAWS}")
    check_seed(seed)
    described = Vehicle.named(vehicle)
    values, _ = believed(described).sample(draws, seed)
    out = []
    for i, row in enumerate(values):
        priors = {n: ParameterPrior(initial=float(v)) for n, v in zip(NOMINAL_UNITS, row, strict=True)}
        one = described.model_copy(update={"parameters": priors})
        try:
            out.append(Draw(seed + i, one, simulate(one, seed=seed + i, random=True, **how)))
        except FlightError as error:
            out.append(Draw(seed + i, one, None, error.found))
    return out


def believed(vehicle: Vehicle) -> ParameterSet:
    """The values of a vehicle file with their standard deviations."""
    listed = []
    for name, unit in NOMINAL_UNITS.items():
        prior = vehicle.parameters[name]
        status = Status.IDENTIFIED if prior.sigma else Status.PRIOR_DOMINATED
        spread = (prior.sigma or 0.0, prior.initial, prior.limits, status)
        listed.append(Parameter(name, unit, prior.initial, *spread))
    return ParameterSet(tuple(listed), vehicle.covariance)


def check_suffix(path: str | Path) -> None:
    """Raises SimulateError for a suffix of no format that is written."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise SimulateError(f"'{path}' has the suffix of no format", ", ".join(SUFFIXES) + " or udpout:HOST:PORT")


def parse_effects(
    texts: Sequence[str], vehicle: Vehicle, seed: int, seconds: float
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Reads effects as written on the command line, ``name`` or ``name:key=value,key=value``.

    Args:
        vehicle: scales drawn sizes.
        seed: decides drawn sizes.

    Returns:
        Effects of the catalogue, and effects outside it.

    Raises:
        ParameterError: unknown name, or values that are not numbers.
    """
    from quadid.flight import OUTSIDE, check_effects, draw_effect, draw_outside

    effects: dict[str, dict[str, float]] = {}
    outside: dict[str, dict[str, float]] = {}
    for text in texts:
        name, _, rest = text.partition(":")
        values = key_numbers(rest, text)
        if name in OUTSIDE:
            outside[name] = {**draw_outside(name, seed, 1.0, vehicle), **values}
        elif name not in EFFECTS:
            raise ParameterError(f"unknown effect '{name}'", fix=nearest(name, [*EFFECTS, *OUTSIDE]))
        elif values:
            effects[name] = values
        else:
            effects |= {k: v for k, v in draw_effect(name, seed, 1.0, vehicle, seconds).items() if k not in effects}
    check_effects(effects, len(vehicle.rotors))
    return effects, outside


def read_manoeuvre(path: Path) -> list[Segment]:
    """Reads a manoeuvre file: a list of segments, or a mapping with that list as ``segments``.

    Raises:
        SimulateError: no such file, or no list of segments.
        VehicleError: not YAML, or with anchors, tags or doubled keys.
        ParameterError: a segment that cannot be flown.
    """
    from quadid.flight import Segment

    try:
        data = read_value(read_regular(path).decode("utf-8"), path.name)
    except FileNotFoundError as error:
        raise SimulateError(f"no manoeuvre file {path}", "a YAML file", "check the path") from error
    except OSError as error:
        raise SimulateError(f"cannot read {path}: {error.strerror}", "a YAML file", "check the path") from error
    except UnicodeDecodeError as error:
        raise SimulateError(f"{path.name}: not text", "a list of segments") from error
    if isinstance(data, dict):
        data = data.get("segments")
    if not isinstance(data, list) or not all(isinstance(entry, dict) for entry in data) or not data:
        raise SimulateError(f"{path.name} holds no list of segments", "axis, kind, start, duration, amplitude each")
    return [Segment.from_mapping(entry) for entry in data]


def summary(flight: Flight, seed: int, profile: str) -> dict[str, Any]:
    """Flight as JSON: the truth, the effects, the stabiliser's gains and how much the vehicle moved."""
    truth = flight.truth
    parameters = truth.parameters.as_dict()
    upright = float(down(truth.quaternion)[:, 2].min())
    squares = (flight.window.rotor_speed**2).sum(axis=1)
    return {
        "schema": "quadid.simulate/1",
        "log": None,
        "vehicle": flight.vehicle.name,
        "seed": seed,
        "profile": profile,
        "seconds": len(flight.window) * flight.window.dt,
        "rows": len(flight.window),
        "mass": truth.parameters.mass,
        "parameters": [{"name": n, "unit": NOMINAL_UNITS[n], "value": v} for n, v in parameters.items()],
        "effects": {name: dict(values) for name, values in truth.effects.items()},
        "outside": {name: dict(values) for name, values in truth.outside.items()},
        "stabiliser": {"gains": dict(flight.gains)},
        "excitation": {
            "rates_rms": truth.rates.std(axis=0),
            "tilt_max": math.acos(max(-1.0, min(1.0, upright))),
            "thrust_variation": float(squares.std() / squares.mean()),
        },
    }
