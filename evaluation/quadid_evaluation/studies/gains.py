"""`make gains`: gains of `quadid gains`, flown by each autopilot's own law around the truth, beside what they promise.

    python -m quadid_evaluation.studies.gains --out docs/results

Three vehicles, each an individual with motor lag and a late command, are identified from a minute of flight.  Gains
for PX4, ArduPilot and Betaflight come from what was found; controller and mixer of each are written here once more,
with places of rotors in place of the autopilot's tables, and close the loop around the flown vehicle.  Tones added to
the controller's output, and to the rate asked for, give the open loops as they are; steps give bandwidth and overshoot.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from quadid_replay.ulog import allocation
from scipy.interpolate import PchipInterpolator
from scipy.signal import butter, lfilter

import quadid
from quadid.app.gains import Gains
from quadid.errors import QuadidError
from quadid.flight import SteppedFlight, TruthParameters, draw_truth, fly
from quadid.flight.setup import Effects
from quadid.identification.fit import FitOptions, fit
from quadid.identification.result import fitted_vehicle
from quadid.parameters import NOMINAL_NAMES
from quadid.report.autopilots import AUTOPILOTS, AXES
from quadid.report.programs import export
from quadid.types import FloatArray
from quadid.vehicle import Command, Vehicle
from quadid_evaluation.harness import study, table
from quadid_evaluation.studies.truth import poor_guess

# --- Rate and attitude law of each autopilot, in its own parameters and units


RATE = {"px4": ("IMU_GYRO_RATEMAX", 400.0), "ardupilot": ("SCHED_LOOP_RATE", 400.0), "betaflight": ("pid_rate", 1000.0)}
"""Rate of the loop, by parameter [Hz]: one with which the truth keeps step."""
Mixer = Callable[[FloatArray, float], FloatArray]
"""From outputs about the axes and the command in hover to motor commands 0..1."""


def px4_mixer(vehicle: Vehicle) -> Mixer:
    """PX4's allocation by what `quadid export` tells it, as the reader of its logs repeats it."""
    rows = [line.split("\t") for line in export(vehicle, "px4", "x")[".params"].splitlines() if line[:1] == "1"]
    mix = allocation({"CA_AIRFRAME": 0.0, **{row[2]: float(row[3]) for row in rows}})
    assert mix is not None
    return lambda out, hover: mix @ np.array([*out, 0.0, 0.0, -hover])


def ardupilot_mixer(vehicle: Vehicle) -> Mixer:
    """Factors of the motors, largest 0.5, from the places of the rotors; thrust to command by MOT_THST_EXPO 1."""
    x, y, _ = vehicle.rotor_positions.T
    factors = np.column_stack([-y, x, vehicle.spins])
    factors *= 0.5 / np.abs(factors).max(axis=0)
    if vehicle.command.kind == "thrust":
        return lambda out, hover: hover + factors @ out

    def mixed(out: FloatArray, hover: float) -> FloatArray:
        thrust = ((hover - 0.15) / 0.8) ** 2 + factors @ out
        return np.asarray(0.15 + 0.8 * np.sqrt(np.maximum(thrust, 0.0)))

    return mixed


def betaflight_mixer(vehicle: Vehicle) -> Mixer:
    """QUADX or QUADP, above the idle of 5.5 %."""
    x, y, _ = np.sign(np.round(vehicle.rotor_positions.T, 6))
    return lambda out, hover: hover + 0.945 * np.column_stack([-y, x, vehicle.spins]) @ out


MIXERS = {"px4": px4_mixer, "ardupilot": ardupilot_mixer, "betaflight": betaflight_mixer}


class Flown(NamedTuple):
    """Signals of a flight at the controller's rate, shape (n, 3) each.

    Attributes:
        period: of the loop [s].
        rate, angle: true ones [rad/s], [rad]; output: of the controller, without what is added to it.
        asked: rate that the loop follows [rad/s].
    """

    period: float
    rate: FloatArray
    angle: FloatArray
    output: FloatArray
    asked: FloatArray


def flown(
    found: Gains,
    vehicle: Vehicle,
    truth: TruthParameters,
    effects: Effects,
    rate: FloatArray | None = None,
    angle: FloatArray | None = None,
    output: FloatArray | None = None,
) -> Flown:
    """Flies an autopilot's law around the truth.

    Args:
        vehicle: as the truth is built: geometry, mass, meaning of a command.
        rate: asked for, beside what the attitude loop asks for [rad/s], shape (n, 3).
        angle: asked for [rad], shape (n, 3); None: the attitude loop is open.
        output: added to that of the controller, shape (n, 3).
    """
    form = found.result["format"]
    hz, autopilot, values = RATE[form][1], AUTOPILOTS[form], found.values
    p, i, d, a = (np.array([values.get(names[k], 0.0) for names in autopilot.names]) for k in range(4))
    if form == "betaflight":  # sums of thousandths, errors in degrees
        p, i, d = (np.degrees(k * g) / 1000.0 for k, g in ((0.032029, p), (0.244381, i), (0.000529, d)))
        a = a / 10.0
    flight, mixed = SteppedFlight(vehicle, truth, effects=effects), MIXERS[form](vehicle)
    full = vehicle.command.max_speed
    assert full is not None
    linear = vehicle.command.kind == "thrust"
    start = float(flight.rotor_speed[0]) / full
    hover = start**2 if linear else start
    filters = [butter(2, autopilot.gyro[1], fs=hz), butter(1, autopilot.derivative[1], fs=hz)]
    if autopilot.on_error:
        filters += [butter(1, autopilot.target[1], fs=hz), butter(1, autopilot.yaw_error[1], fs=hz)]
    memory = [np.zeros((len(f[0]) - 1, 3)) for f in filters]

    def passed(k: int, signal: FloatArray) -> FloatArray:
        result, memory[k] = lfilter(*filters[k], signal[None], axis=0, zi=memory[k])
        return np.asarray(result[0])

    inputs = [given for given in (rate, angle, output) if given is not None]
    none = np.zeros_like(inputs[0])
    wanted, added = (none if given is None else given for given in (rate, output))
    integral, last, rows = np.zeros(3), np.zeros(3), []
    for k in range(len(none)):
        q = flight.quaternion
        tilt = 2.0 * q[1:] * np.sign(q[0])
        asked = wanted[k] if angle is None else wanted[k] + a * (angle[k] - tilt)
        gyro = passed(0, flight.rate)
        error = asked - gyro
        if autopilot.on_error:
            error = passed(2, asked) - gyro
            error[2] = passed(3, error)[2]
        seen = error if autopilot.on_error else -gyro
        change, last = (seen - last) * hz, seen
        integral = integral + error / hz
        demand = p * error + i * integral + d * passed(1, change)
        rows.append((flight.rate, tilt, demand, asked))
        command = np.clip(mixed(demand + added[k], hover), 0.0, 1.0)
        flight.step(full * (np.sqrt(command) if linear else command), 1.0 / hz)
    return Flown(1.0 / hz, *(np.array(signal) for signal in zip(*rows, strict=True)))


# --- What a flight shows


STEP, TILT = 0.2, 0.05
"""Asked for [rad/s], [rad]: small, so that thrust stays linear."""
PERIOD = 8.0
"""Of the tones [s]; the first period is not looked at, the second is."""


def step(
    found: Gains,
    vehicle: Vehicle,
    truth: TruthParameters,
    effects: Effects,
    axis: int,
    angle: bool = False,
    seconds: float = 2.5,
) -> tuple[float, FloatArray]:
    """Rate, or angle, of one axis after a step of what is asked for, over it; the period of the loop first [s]."""
    size = TILT if angle else STEP
    asked = np.tile(size * np.eye(3)[axis], (round(seconds * RATE[found.result["format"]][1]), 1))
    out = flown(found, vehicle, truth, effects, **{"angle" if angle else "rate": asked})
    return out.period, (out.angle if angle else out.rate)[:, axis] / size


def bandwidth(period: float, response: FloatArray) -> float:
    """Frequency at which the response has fallen by 3 dB for good [Hz], from that to a step."""
    hz = np.arange(0.1, 50.0, 0.01)
    t = period * (np.arange(len(response) - 1) + 0.5)
    size = np.abs(np.exp(-2j * np.pi * np.outer(hz, t)) @ np.diff(response))
    return float(hz[np.flatnonzero(size >= math.sqrt(0.5))[-1]])


def margins(
    found: Gains, vehicle: Vehicle, truth: TruthParameters, effects: Effects, angle: bool
) -> list[tuple[float, float]]:
    """Phase [deg] and gain margin [dB] of every axis, from the open loops that tones show as the vehicle flies.

    With s added to a signal inside the loop, and u that signal without it, the loop is -u / (u + s).
    """
    hz, autopilot = RATE[found.result["format"]][1], AUTOPILOTS[found.result["format"]]
    n = round(PERIOD * hz)
    lines = np.unique(np.round(np.geomspace(1.0, 40.0 * PERIOD, 48)).astype(int))
    t, rng = np.arange(2 * n)[:, None] / hz, np.random.default_rng(1)
    tones = np.zeros((2 * n, 3))
    for axis in range(3):  # each axis has tones of its own, yaw the slowest
        own = lines[2 - axis :: 3]
        tones[:, axis] = np.sin(2.0 * np.pi * t / PERIOD * own + rng.uniform(0.0, 2.0 * np.pi, len(own))).sum(axis=1)
    tones *= STEP / 2.0 / tones.std(axis=0)
    if angle:
        out = flown(found, vehicle, truth, effects, rate=tones, angle=np.zeros_like(tones))
        added, whole = tones, out.asked
    else:
        per = np.array([found.values[names[0]] for names in autopilot.names]) * autopilot.units[0]
        out = flown(found, vehicle, truth, effects, output=tones * per)
        added, whole = tones * per, out.output + tones * per
    result = []
    for axis in range(3):
        own = lines[2 - axis :: 3]
        s, total = (np.fft.rfft(signal[n:, axis])[own] for signal in (added, whole))
        loop = s / total - 1.0  # between the tones its size and phase follow log f
        fine = np.geomspace(own[0], own[-1], 2000)
        seen = np.log(np.maximum(np.abs(loop), 1e-12)), np.unwrap(np.angle(loop))
        size, phase = (PchipInterpolator(np.log(own), values)(np.log(fine)) for values in seen)
        above, beyond = np.flatnonzero(size >= 0.0), np.flatnonzero(phase <= -math.pi)
        crossed = 180.0 + math.degrees(phase[above[-1]]) if len(above) else math.inf
        result.append((crossed, -20.0 / math.log(10.0) * size[beyond[0]] if len(beyond) else math.inf))
    return result


# --- The study


LATE = {"motor_lag": {"tau": 0.03}, "command_delay": {"delay": 0.006}}
FOUND = (*NOMINAL_NAMES, "motor_lag.tau", "command_delay.delay")
VEHICLES = {"pelican": 800.0, "crazyflie": 2700.0, "hexacopter": 800.0}
"""Rotor speed at full command [rad/s]."""
SMALL = {"crazyflie": {"motor_lag": {"tau": 0.04}, "command_delay": {"delay": 0.004}}}
"""A brushed motor is slower, and the loop on board faster."""


def built(name: str) -> tuple[Vehicle, Effects]:
    """A shipped vehicle whose motors take a command 0..1, and how late they follow."""
    vehicle = Vehicle.shipped(name)
    if vehicle.command.kind != "thrust":
        vehicle = vehicle.model_copy(update={"command": Command(kind="normalized", max_speed=VEHICLES[name])})
    return vehicle, SMALL.get(name, LATE)


@cache
def identified(name: str, seed: int) -> tuple[Vehicle, TruthParameters]:
    """An individual as a minute of flight shows it, from a poor guess, and its truth."""
    vehicle, effects = built(name)
    truth = draw_truth(vehicle, seed)
    window = fly(vehicle, truth, 60.0, seed, effects=effects, log_rate=100.0).window
    guess = poor_guess(vehicle, truth.as_dict(), seed)
    return fitted_vehicle(fit([window], guess, FitOptions(iterations=0, seed=seed), FOUND)), truth


def outside(response: tuple[float, FloatArray], loops: Any, angle: bool) -> float:
    """Largest distance of a step response from the band over the intervals."""
    t, band = loops.step(angle)
    y = np.interp(t, response[0] * np.arange(len(response[1])), response[1])
    return float(np.max(np.maximum(np.maximum(band.min(axis=0) - y, y - band.max(axis=0)), 0.0)))


def rows_of(name: str, form: str, seed: int) -> Iterator[tuple[object, ...]]:
    """One row a loop: what was promised, and what flies."""
    vehicle, effects = built(name)
    try:
        described, truth = identified(name, seed)
        found = quadid.gains(described, form, current={RATE[form][0]: RATE[form][1]}, anyway=True)
    except QuadidError as error:
        yield name, AUTOPILOTS[form].program, f"refused: {error.found}", *[""] * 5
        return
    for angle in (False, True):
        loop = "attitude" if angle else "rate"
        flew = margins(found, vehicle, truth, effects, angle)
        for k, axis in enumerate(AXES):
            promised: Mapping[str, Any] | None = found.result["axes"][k][loop]
            if promised is None:
                continue
            response = step(found, vehicle, truth, effects, k, angle)
            phase, gain = flew[k]
            yield (
                name,
                AUTOPILOTS[form].program,
                f"{axis} {loop}",
                f"{promised['bandwidth']:.2f}, {bandwidth(*response):.2f}",
                f"{promised['phase_margin']:.0f}, {phase:.0f}",
                f"{promised['gain_margin']:.1f}, {gain:.1f}",
                f"{100 * promised['overshoot']:.0f}, {100 * max(response[1].max() - 1.0, 0.0):.0f}",
                f"{outside(response, found.loops[axis], angle):.3f}",
            )


def promises(seed: int) -> list[str]:
    """Every loop of every vehicle and autopilot, as Markdown."""
    rows = []
    for name, form in product(VEHICLES, AUTOPILOTS):
        for row in rows_of(name, form, seed):
            rows.append(row)
            print(*row, sep=" | ", flush=True)
    units = ("bandwidth [Hz]", "phase margin [deg]", "gain margin [dB]", "overshoot [%]", "outside of the band")
    return [
        f"`make gains`, seed {seed}. Each individual is identified from a minute of flight, from guesses off by up to "
        "35 %; its gains are flown by the autopilot's own law around the truth. Promised, then obtained; last the "
        "largest distance of the response to a unit step from its band over the 95 % intervals.",
        "",
        *table(("vehicle", "autopilot", "loop", *units), rows),
    ]


if __name__ == "__main__":
    study(__doc__, "gains.md", "Gains, flown", {"loops": lambda g: promises(g.seed)}, seed=3)
