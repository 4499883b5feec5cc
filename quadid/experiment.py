"""A manoeuvre that reveals most: candidate movements are flown in simulation, weighed, chosen and put in a row.

The flights are those of the simulated vehicle with the parameters believed so far; movements are chosen by the Fisher
information that a log of them would carry.  What is promised is what a fit makes of a log of the whole manoeuvre
(`AsLogged`), where a log or a fit of one tells what moves the vehicle beyond its model: the information knows of
sensor noise alone.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import yaml

from quadid.data.grid import to_windows
from quadid.data.window import Recording, Window
from quadid.errors import NotIdentifiableError
from quadid.flight import Flight, FlightError, Segment, TruthParameters, fly
from quadid.flight.loop import SensorNoise
from quadid.flight.pilot import PILOT_STEP
from quadid.identification.fit import Progress as Advance
from quadid.identification.noise import NoiseModel
from quadid.identification.uncertainty import d_optimal, excitation, halfwidths
from quadid.parameters import NOMINAL_NAMES
from quadid.rotation import down
from quadid.types import FloatArray
from quadid.vehicle import RandomForces, Vehicle

BLOCK = 6.0
"""Length of one movement [s]."""
PAUSE = 0.5
"""Rest after each [s], in which the vehicle levels."""
BANDS = ((0.3, 1.0), (0.8, 2.0), (1.5, 3.5))
"""Frequencies of the stick movements [Hz], lowest and highest."""
MIXES = (
    ("roll",),
    ("pitch",),
    ("yaw",),
    ("throttle",),
    ("roll", "pitch"),
    ("roll", "yaw"),
    ("pitch", "yaw"),
    ("roll", "pitch", "yaw"),
    ("roll", "pitch", "yaw", "throttle"),
)
AMPLITUDES = {"roll": (0.1, 0.35), "pitch": (0.1, 0.35), "yaw": (0.3, 1.5), "throttle": (0.07, 0.15)}
"""Start and latest end of the search for the largest amplitude within limits: rad rms, fraction of hover
thrust."""
SWEEP = (0.5, 3.5)
"""Frequencies of sweeps of one axis at a time [Hz], lowest and highest."""
ROUNDS = 3
FASTEST = 500.0
"""Rate of logs that simulated flights are thinned from [Hz]."""


@dataclass(frozen=True)
class Limits:
    """Limits of a manoeuvre: tilt [rad], body rate [rad/s]."""

    tilt: float
    rate: float


@dataclass(frozen=True)
class Movement:
    """One block: its name, its segments from time 0, and the information it brings (P, P)."""

    name: str
    segments: tuple[Segment, ...]
    information: FloatArray


@dataclass(frozen=True)
class Proposal:
    """A manoeuvre and what it would give.

    Attributes:
        movements: chosen blocks in the order flown, alike ones together, the most frequent first.
        segments: of the whole manoeuvre.
        seconds: its length.
        peak: largest tilt [rad] and rate [rad/s] in simulation.
        now, pilot, after: relative 95 % half-widths now, after as long a gentle flight, after the manoeuvre, (P,).
        flight: the manoeuvre flown in simulation.
        sweeps: one axis at a time in as long, for autopilots that can do no more; swept: half-widths after them.
    """

    movements: tuple[Movement, ...]
    segments: tuple[Segment, ...]
    seconds: float
    peak: Limits
    now: FloatArray
    pilot: FloatArray
    after: FloatArray
    flight: Flight
    sweeps: tuple[Segment, ...]
    swept: FloatArray

    @property
    def room(self) -> FloatArray:
        """Largest distance to the side, and upwards and downwards, from where it began [m], shape (3,)."""
        moved = self.flight.truth.position - self.flight.truth.position[0]
        return np.array([np.hypot(moved[:, 0], moved[:, 1]).max(), max(-moved[:, 2].min(), 0.0), moved[:, 2].max()])


class TrialFlights:
    """Flies what is believed of the vehicle and weighs the flights."""

    def __init__(self, vehicle: Vehicle, noise: NoiseModel | None, seed: int) -> None:
        """Takes the vehicle file's values for the truth; `noise` as found in logs, or None for a typical one."""
        self.vehicle, self.noise, self.seed = vehicle, noise, seed
        self.truth = TruthParameters(**{n: vehicle.parameters[n].initial for n in NOMINAL_NAMES}, mass=vehicle.mass)

    def fly(self, segments: Sequence[Segment], seconds: float, profile: str = "scripted") -> Flight:
        """One flight; raises FlightError when it ends on the ground."""
        return fly(
            self.vehicle,
            self.truth,
            seconds,
            self.seed,
            profile,
            effects=self.vehicle.effects,
            segments=segments if profile == "scripted" else None,
        )

    def information(self, flight: Flight) -> FloatArray:
        """Fisher information of the log parameters in the log of a flight, shape (P, P)."""
        return excitation([flight.window], self.vehicle, noise=self.noise).information

    def within(
        self, segments: tuple[Segment, ...], seconds: float, limits: Limits
    ) -> tuple[tuple[Segment, ...], Flight]:
        """The segments at the largest amplitude within the limits, and their flight.

        Raises:
            FlightError: they cannot be flown.
        """
        flight, safe = None, None
        for _ in range(ROUNDS):
            flight = self.fly(segments, seconds)
            found = peaks(flight)
            room = min(limits.tilt / found.tilt, limits.rate / found.rate)
            if room >= 1.0:
                safe = (segments, flight)
            if 0.95 <= room <= 1.1:
                break
            segments = scaled(segments, float(np.clip(0.97 * room, 0.2, 3.0)))
        if safe is None:
            raise FlightError("a movement exceeds the limits at any amplitude tried", "a wider limit")
        return safe


class AsLogged:
    """Flies manoeuvres as they would be logged: effects, random forces and noise found so far, the log's own rates."""

    def __init__(
        self, simulator: TrialFlights, random: RandomForces, like: Recording | None = None, rate: float | None = None
    ) -> None:
        """Takes what was found.

        Args:
            simulator: what is believed of the vehicle, with the noise that was found.  A delay below nothing is that
                of its rotors' readings.
            random: what moves it beyond its model.
            like: a log of the vehicle; each channel will come as often as there.
            rate: of its grid [Hz].  Without a log, rows come as the pilot's; a loop whose rotors are measured between
                its commands is faster.
        """
        white = NoiseModel.guess(9).white if simulator.noise is None else simulator.noise.white
        gyro, attitude, accel = (float(np.mean(white[i : i + 3])) for i in (0, 3, 6))
        self._noise = SensorNoise(gyro=gyro, attitude=attitude, accel=accel)
        self._simulator, self._random, self._like = simulator, random, {} if like is None else like.channels
        self._effects = dict(simulator.vehicle.effects)
        self._late = max(-self._effects.get("command_delay", {}).get("delay", 0.0), 0.0)
        if self._late:
            del self._effects["command_delay"]
        self._grid = FASTEST / max(round(FASTEST * (PILOT_STEP if rate is None else 1.0 / rate)), 1)
        self._rate = FASTEST if rate is None and simulator.vehicle.command.sampling == "instant" else self._grid

    def windows(self, segments: Sequence[Segment], seconds: float, profile: str = "scripted") -> list[Window]:
        """One flight, logged; raises FlightError when it ends on the ground."""
        simulator = self._simulator
        flown = fly(
            simulator.vehicle,
            simulator.truth,
            seconds,
            simulator.seed,
            profile,
            effects=self._effects,
            random=self._random,
            segments=segments if profile == "scripted" else None,
            noise=self._noise,
            log_rate=self._rate,
        ).recording
        channels = {}
        for name, channel in flown.channels.items():
            step = float(np.median(np.diff(self._like[name].t))) if name in self._like else 1.0 / self._grid
            rows = slice(None, None, max(round(self._rate * step), 1))
            late = self._late if name == "rotor_speed" else 0.0
            channels[name] = replace(channel, t=channel.t[rows] + late, values=channel.values[rows])
        return to_windows(replace(flown, channels=channels), simulator.vehicle, self._grid)


def peaks(flight: Flight) -> Limits:
    """Largest tilt and body rate that the log of a flight shows."""
    q, gyro = flight.window.attitude, flight.window.gyro
    assert q is not None
    assert gyro is not None
    tilt = np.arccos(np.clip(down(q)[:, 2], -1.0, 1.0))
    return Limits(float(np.nanmax(tilt)), float(np.nanmax(np.abs(gyro))))


def scaled(segments: Sequence[Segment], factor: float) -> tuple[Segment, ...]:
    """Segments with their amplitudes scaled, each up to the largest of its axis."""
    return tuple(replace(s, amplitude=min(s.amplitude * factor, AMPLITUDES[s.axis][1])) for s in segments)


def movements(simulator: TrialFlights, limits: Limits, advance: Advance) -> list[Movement]:
    """Every candidate movement at the amplitude that the limits allow, with its information."""
    out = []
    todo = [(mix, band) for mix in MIXES for band in BANDS]
    for i, (mix, (low, high)) in enumerate(todo):
        advance("movements", i / len(todo))
        start = tuple(Segment(axis, "multisine", 0.0, BLOCK, AMPLITUDES[axis][0], low, high) for axis in mix)
        try:
            segments, flight = simulator.within(start, BLOCK + PAUSE, limits)
        except FlightError:
            continue
        name = f"{' + '.join(mix)}, {low:g} to {high:g} Hz"
        out.append(Movement(name, segments, simulator.information(flight)))
    return out


def design_manoeuvre(
    simulator: TrialFlights, known: FloatArray, limits: Limits, seconds: float, advance: Advance
) -> Proposal:
    """Chooses a manoeuvre of about `seconds` and predicts what it would give.

    Args:
        known: information there already is, prior included, shape (P, P).

    Raises:
        NotIdentifiableError: no movement stays within the limits.
    """
    candidates = movements(simulator, limits, advance)
    if not candidates:
        raise NotIdentifiableError(
            "no movement stays within the limits",
            "a tilt of 5 degrees or more, a rate of 30 deg/s or more",
            "use wider --tilt and --rate-limit",
        )
    blocks = max(round(seconds / (BLOCK + PAUSE)), 1)
    chosen = d_optimal(np.array([m.information for m in candidates]), known, blocks)
    picked = tuple(candidates[i] for i in sorted(chosen, key=lambda i: (-chosen.count(i), i)))
    length = blocks * (BLOCK + PAUSE)
    row = in_a_row(picked)
    for _ in range(ROUNDS):
        flight = simulator.fly(row, length)
        peak = peaks(flight)
        excess = max(peak.tilt / limits.tilt, peak.rate / limits.rate)
        if excess <= 1.0:
            break
        picked = tuple(replace(m, segments=scaled(m.segments, 0.97 / excess)) for m in picked)
        row = in_a_row(picked)
    advance("movements", 1.0)
    gentle = simulator.information(simulator.fly((), length, "gentle"))
    gained = simulator.information(flight)
    sweeps = one_axis_at_a_time(simulator, limits, length)
    swept = simulator.information(simulator.fly(sweeps, length)) if sweeps else 0.0 * known
    return Proposal(
        picked,
        row,
        length,
        peak,
        halfwidths(known),
        halfwidths(known + gentle),
        halfwidths(known + gained),
        flight,
        sweeps,
        halfwidths(known + swept),
    )


def one_axis_at_a_time(simulator: TrialFlights, limits: Limits, seconds: float) -> tuple[Segment, ...]:
    """Sweeps of roll, pitch, yaw and throttle one after the other, as large as the limits allow.

    Returns:
        None where there is too little time for two swings of the lowest frequency.
    """
    each = seconds / len(AMPLITUDES)
    span = each - PAUSE
    if span <= 4.0 / SWEEP[0]:
        return ()
    out: list[Segment] = []
    for axis, (size, _) in AMPLITUDES.items():
        first = Segment(axis, "sweep", 0.0, span, size, *SWEEP)
        try:
            (largest,), _ = simulator.within((first,), each, limits)
        except FlightError:
            continue
        out.append(replace(largest, start=len(out) * each))
    return tuple(out)


def in_a_row(picked: Sequence[Movement]) -> tuple[Segment, ...]:
    """Segments of movements flown one after the other."""
    return tuple(
        replace(s, start=i * (BLOCK + PAUSE) + s.start) for i, movement in enumerate(picked) for s in movement.segments
    )


def manoeuvre_file(vehicle: str, proposal: Proposal) -> str:
    """The manoeuvre as YAML that ``quadid simulate --manoeuvre`` flies."""
    segments = [{k: v if isinstance(v, str) else round(v, 5) for k, v in asdict(s).items()} for s in proposal.segments]
    body: dict[str, Any] = {"vehicle": vehicle, "seconds": proposal.seconds, "segments": segments}
    units = "# amplitude: rms of roll, pitch, yaw [rad]; fraction of hover thrust for throttle. start, duration [s].\n"
    return units + yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=120)
