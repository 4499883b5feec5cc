"""`make judging`: single mistakes on logs of many vehicles, and the first line that each is answered with.

Every log is right as it is.  One thing is made wrong at a time: axes, signs, units, time, motors, the vehicle file.  A
cell is `right` where the first line names the mistake, `silent` where nothing is said, else it is the wrong line.
"""

import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from quadid_replay import open_log
from quadid_replay.columns import from_euler
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

import quadid
from quadid.app.logs import LogPart, check_conventions
from quadid.checks import CheckResult, inspect
from quadid.data.window import Channel, Recording, mounting_matrix, sample_period
from quadid.errors import LogError
from quadid.rotation import conjugate, continuous_sign, euler, product
from quadid.types import FloatArray
from quadid.vehicle import Rotor, Vehicle
from quadid_evaluation.harness import options, put, table

Log = tuple[Recording, Vehicle]
Made = Callable[[Recording, Vehicle], Log]
"""A right log, made wrong."""
ROTORS = "rotors"
TITLE = "Mistakes by vehicle"


class Mistake(NamedTuple):
    """One thing made wrong: its name, how, and what the first line must contain (a regular expression)."""

    name: str
    made: Made
    named: str


# --- Vehicles: simulated ones of four forms, and recorded flights


SIMULATED = ("pelican", "pelican_x", "hexacopter", "x8", "crazyflie")
RECORDED = {
    "crazyflie_rpm": ("crazyflie_rpm/figure8_27.csv", "crazyflie_rpm/vehicle.yaml"),
    "brushed": ("brushed/jana00.csv", "brushed/vehicle.yaml"),
    "nanodrone": ("nanodrone/random_run1.csv", "nanodrone/vehicle.yaml"),
    "ardupilot": ("ardupilot_sitl/quad_sq.bin", "ardupilot_sitl/quad_sq.yaml"),
    "iris": ("iris/sideways.csv", "iris/vehicle.yaml"),
    "mujoco hexa": (
        "findings/vehicles/2_hexa_wrong_logs/clean.csv",
        "findings/vehicles/2_hexa_wrong_logs/vehicle.yaml",
    ),
    "mujoco x8": (
        "findings/vehicles/5_x8_feedback_and_health/train.csv",
        "findings/vehicles/5_x8_feedback_and_health/vehicle.yaml",
    ),
}


def described(name: str) -> Vehicle:
    """A shipped vehicle, or a Pelican with two rotors on each arm."""
    if name != "x8":
        return Vehicle.shipped(name)
    four = Vehicle.shipped("pelican_x")
    below = tuple(Rotor(position=(*r.position[:2], 0.05), spin=-r.spin) for r in four.rotors)
    return four.model_copy(update={"name": "x8", "mass": 2.0 * four.mass, "rotors": (*four.rotors, *below)})


def flown(name: str, data: Path) -> Log:
    """A right log and its vehicle: flown here for 40 s, or recorded."""
    if name in RECORDED:
        log, file = (data / part for part in RECORDED[name])
        vehicle = Vehicle.named(file)
        return open_log(log, "auto", vehicle.columns), vehicle
    vehicle = described(name)
    flight = quadid.simulate(vehicle, seconds=30.0, seed=7, extras=("velocity", "position")).flight
    return flight.recording, vehicle


# --- Ways to spoil a channel; each raises KeyError where the log has none


def changed(recording: Recording, **values: FloatArray) -> Recording:
    """A recording with other numbers in those of these channels that it has."""
    new = {n: replace(recording.channels[n], values=v) for n, v in values.items() if n in recording.channels}
    return replace(recording, channels={**recording.channels, **new})


def channel(r: Recording, name: str) -> Channel:
    """A channel; `ROTORS` is that of speeds or commands."""
    if name == ROTORS:
        name = "rotor_speed" if "rotor_speed" in r.channels else "motor_command"
    return r.channels[name]


def of(name: str, change: Callable[[FloatArray], FloatArray]) -> Made:
    """A channel whose numbers, shape (n, k), something is done to."""

    def made(r: Recording, v: Vehicle) -> Log:
        c = channel(r, name)
        return changed(r, **{c.name: np.asarray(change(c.values.copy()))}), v

    return made


def scaled(name: str, factor: float | Sequence[float]) -> Made:
    """A channel, times a factor or one for each column."""
    return of(name, lambda values: values * np.asarray(factor))


def columns(name: str, order: Sequence[int]) -> Made:
    """A channel with its columns in another order."""
    return of(name, lambda values: values[:, list(order)])


def exchanged(a: int, b: int) -> Made:
    """Two rotor columns exchanged (counted from 0)."""
    return of(ROTORS, lambda w: w[:, [{a: b, b: a}.get(k, k) for k in range(w.shape[1])]])


def one_rotor(rotor: int, change: Callable[[FloatArray], FloatArray | float]) -> Made:
    """One rotor column changed."""

    def changed_one(w: FloatArray) -> FloatArray:
        w[:, rotor] = change(w[:, rotor])
        return w

    return of(ROTORS, changed_one)


def late(name: str, seconds: float) -> Made:
    """A channel with stamps so much later."""

    def made(r: Recording, v: Vehicle) -> Log:
        c = channel(r, name)
        return replace(r, channels={**r.channels, c.name: replace(c, t=c.t + seconds)}), v

    return made


def held(name: str, rate: float) -> Made:
    """A channel that changes at a lower rate [Hz] and is repeated between."""

    def made(r: Recording, v: Vehicle) -> Log:
        c = channel(r, name)
        at = np.searchsorted(c.t, np.floor((c.t - c.t[0]) * rate + 1e-6) / rate + c.t[0] - 1e-9)
        return changed(r, **{c.name: c.values[np.clip(at, 0, len(c.t) - 1)]}), v

    return made


def stepped(size: float) -> Made:
    """Roll, pitch and yaw in steps [deg]."""
    return of("attitude", lambda q: from_euler(np.radians(size * np.round(np.degrees(euler(q)) / size))))


def enu(r: Recording, v: Vehicle) -> Log:
    """World axes east, north, up; the body stays forward, right, down."""
    q, swap = r.channels["attitude"].values, np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
    moving = [c for n, c in r.channels.items() if n in ("velocity", "position")]
    world = {c.name: c.values[:, [1, 0, 2]] * [1.0, 1.0, -1.0] for c in moving}
    return changed(r, attitude=product(np.broadcast_to(swap, q.shape), q), **world), v


def flu(r: Recording, v: Vehicle) -> Log:
    """Body axes forward, left, up in gyro, accelerometer and attitude."""
    turned = {n: r.channels[n].values * [1.0, -1.0, -1.0] for n in ("gyro", "accel")}
    q, half = r.channels["attitude"].values, np.array([0.0, 1.0, 0.0, 0.0])
    return changed(r, attitude=product(q, np.broadcast_to(half, q.shape)), **turned), v


def imu_turned(r: Recording, v: Vehicle) -> Log:
    """Gyro and accelerometer stand 10 deg further about z than the attitude."""
    turn = mounting_matrix((0.0, 0.0, np.radians(10.0)))
    return changed(r, **{n: r.channels[n].values @ turn.T for n in ("gyro", "accel")}), v


def angles_at(r: Recording, t: FloatArray) -> FloatArray:
    """Roll, pitch and yaw [rad], yaw unwrapped, at times [s], shape (n, 3)."""
    q = r.channels["attitude"]
    return np.column_stack([np.interp(t, q.t, column) for column in np.unwrap(euler(q.values), axis=0).T])


def euler_rates(r: Recording, v: Vehicle) -> Log:
    """The gyro holds rates of roll, pitch and yaw angle."""
    c = r.channels["gyro"]
    roll, pitch, _ = angles_at(r, c.t).T
    p, q_, r_ = c.values.T
    heading = (q_ * np.sin(roll) + r_ * np.cos(roll)) / np.cos(pitch)
    rates = (p + heading * np.sin(pitch), q_ * np.cos(roll) - r_ * np.sin(roll), heading)
    return changed(r, gyro=np.column_stack(rates)), v


def differentiated(r: Recording, v: Vehicle) -> Log:
    """The gyro is the change of roll, pitch and yaw from row to row."""
    t = r.channels["gyro"].t
    return changed(r, gyro=np.gradient(angles_at(r, t), t, axis=0)), v


def turned_rates(r: Recording, v: Vehicle) -> Log:
    """The gyro is the turn of the attitude from row to row."""
    q = r.channels["attitude"]
    t, first = np.unique(q.t, return_index=True)
    whole = continuous_sign(q.values[first])
    rates = 2.0 * product(conjugate(whole[:-1]), np.diff(whole, axis=0))[:, 1:] / np.diff(t)[:, None]
    return replace(r, channels={**r.channels, "gyro": Channel("gyro", t[1:], rates, "made")}), v


def clipped(gyro: FloatArray) -> FloatArray:
    """The gyro ends at 1.5 standard deviations."""
    most = 1.5 * np.std(gyro)
    return np.clip(gyro, -most, most)


def smoothed(r: Recording, v: Vehicle) -> Log:
    """The gyro is smoothed over a quarter of a second, without a delay."""
    c = r.channels["gyro"]
    filtered = filtfilt(*butter(2, 4.0, fs=1.0 / sample_period(c.t)), c.values, axis=0)
    return changed(r, gyro=np.asarray(filtered)), v


def gravity_out(r: Recording, v: Vehicle) -> Log:
    """Linear acceleration in place of specific force, as an estimator makes it."""
    c, q = r.channels["accel"], r.channels["attitude"]
    near = np.clip(np.searchsorted(q.t, c.t), 0, len(q.t) - 1)
    down = Rotation.from_quat(q.values[near], scalar_first=True).apply([0.0, 0.0, 9.80665], inverse=True)
    return changed(r, accel=c.values + down), v


def half_speed(r: Recording, v: Vehicle) -> Log:
    """Rotor 2 turns half as fast, by a log of speeds or of thrust."""
    return one_rotor(1, lambda w: (0.25 if v.command.kind == "thrust" else 0.5) * w)(r, v)


def _as_is(x: float, y: float) -> tuple[float, float]:
    return x, y


def file(
    mass: float = 1.0, spun: Sequence[int] = (), placed: Callable[[float, float], tuple[float, float]] = _as_is
) -> Made:
    """A vehicle file with another mass, some spins (of rotors from 0) the other way, rotors at other places."""

    def made(r: Recording, v: Vehicle) -> Log:
        rotors = tuple(
            Rotor(position=(*placed(*x.position[:2]), x.position[2]), spin=-x.spin if k in spun else x.spin)
            for k, x in enumerate(v.rotors)
        )
        return r, v.model_copy(update={"mass": mass * v.mass, "rotors": rotors})

    return made


ORDER = "reorder the rotors|in the order"
LATE_ROTORS = "lags its effect|rotor speeds are late|not in time with the gyro"
MISTAKES: tuple[Mistake, ...] = (
    Mistake("none", lambda r, v: (r, v), "^$"),
    Mistake("gyro in deg/s", scaled("gyro", 180.0 / np.pi), "deg/s"),
    Mistake("acceleration in g", scaled("accel", 1.0 / 9.80665), "in g"),
    Mistake("acceleration reversed", scaled("accel", -1.0), "sign is reversed|points up"),
    Mistake("gravity taken out", gravity_out, "gravity is missing"),
    Mistake("body FLU", flu, "FLU"),
    Mistake("gyro FLU alone", scaled("gyro", (1.0, -1.0, -1.0)), "gyro axes differ.*x = x, y = -y, z = -z"),
    Mistake("accelerometer FLU alone", scaled("accel", (1.0, -1.0, -1.0)), "points up"),
    Mistake("pitch rate reversed", scaled("gyro", (1.0, -1.0, 1.0)), "gyro axes differ.*x = x, y = -y, z = z"),
    Mistake("gyro x and y exchanged", columns("gyro", (1, 0, 2)), "gyro axes differ.*x = y, y = x, z = z"),
    Mistake("world ENU", enu, "ENU"),
    Mistake("world ENU, body FLU", lambda r, v: flu(*enu(r, v)), "ENU|FLU"),
    Mistake("quaternion scalar last", columns("attitude", (1, 2, 3, 0)), "scalar last"),
    Mistake("attitude inverse", of("attitude", conjugate), "world to body"),
    Mistake("vz up", scaled("velocity", (1.0, 1.0, -1.0)), "points up"),
    Mistake("z up", scaled("position", (1.0, 1.0, -1.0)), "points up"),
    Mistake("vx, vy exchanged", columns("velocity", (1, 0, 2)), "world axes.*x = y, y = x"),
    Mistake("Euler rates as gyro", euler_rates, "rates of roll, pitch and yaw"),
    Mistake("differentiated Euler angles as gyro", differentiated, "rates of roll, pitch and yaw|differentiated"),
    Mistake("differentiated quaternion as gyro", turned_rates, "differentiated"),
    Mistake("gyro 100 ms late", late("gyro", 0.1), "gyro comes"),
    Mistake("gyro 200 ms late", late("gyro", 0.2), "gyro comes"),
    Mistake("attitude 100 ms late", late("attitude", 0.1), "attitude comes"),
    Mistake("attitude 200 ms late", late("attitude", 0.2), "attitude comes"),
    Mistake("accelerometer 50 ms late", late("accel", 0.05), "accelerometer answers the rotors"),
    Mistake("attitude in steps of 1 deg", stepped(1.0), "in steps"),
    Mistake("attitude in steps of 5 deg", stepped(5.0), "in steps"),
    Mistake("attitude held at 10 Hz", held("attitude", 10.0), "^$|attitude.*Hz"),
    Mistake("IMU turned by 10 deg", imu_turned, "turned against the attitude"),
    Mistake("gyro clipped", of("gyro", clipped), "limit of its range"),
    Mistake("gyro smoothed at 4 Hz", smoothed, "smoothed without a delay"),
    Mistake("rotors in rpm", scaled("rotor_speed", 30.0 / np.pi), "in rpm"),
    Mistake("rotors in rev/s", scaled("rotor_speed", 0.5 / np.pi), "in rev/s"),
    Mistake("rotors electrical", scaled("rotor_speed", 7.0), "electrical"),
    Mistake("rotors squared", of("rotor_speed", np.square), "squared"),
    Mistake("rotor 2 dead", one_rotor(1, lambda w: 0.0), "rotor 2 reads nothing"),
    Mistake("rotor 2 stuck", one_rotor(1, lambda w: float(np.median(w))), "rotor 2 holds"),
    Mistake("rotor 2 in rpm", one_rotor(1, lambda w: w * 30.0 / np.pi), "rotor 2 reads|neither shares"),
    Mistake("rotor 2 at half speed", half_speed, "rotor 2 reads"),
    Mistake("one column for all", of(ROTORS, lambda w: np.repeat(w[:, :1], w.shape[1], axis=1)), "are the same"),
    Mistake("rotors 30 ms late", late(ROTORS, 0.03), LATE_ROTORS),
    Mistake("rotors 60 ms late", late(ROTORS, 0.06), LATE_ROTORS),
    Mistake("rotors 120 ms late", late(ROTORS, 0.12), LATE_ROTORS),
    Mistake("rotors 0.5 s late", late(ROTORS, 0.5), LATE_ROTORS),
    Mistake("rotors held at 10 Hz", held(ROTORS, 10.0), "too slow|Hz"),
    Mistake("motors 1, 2 exchanged", exchanged(0, 1), ORDER),
    Mistake("motors 1, 3 exchanged", exchanged(0, 2), ORDER),
    Mistake("motors 2, 4 exchanged", exchanged(1, 3), ORDER),
    Mistake("motors one place on", of(ROTORS, lambda w: np.roll(w, 1, axis=1)), ORDER),
    Mistake("motors backwards", of(ROTORS, lambda w: w[:, ::-1]), ORDER),
    Mistake("spins reversed", file(spun=range(12)), "negate the spins"),
    Mistake("spin of rotor 1 reversed", file(spun=(0,)), r"spin of rotor 1\b"),
    Mistake("spins of rotors 1, 2 reversed", file(spun=(0, 1)), r"\b1 and 2\b"),
    Mistake("spins of rotors 1, 3 reversed", file(spun=(0, 2)), r"\b1 and 3\b"),
    Mistake(
        "frame turned by 45 deg",
        file(placed=lambda x, y: ((x - y) * 0.70710678, (x + y) * 0.70710678)),
        "turn the rotor positions",
    ),
    Mistake("positions mirrored", file(placed=lambda x, y: (x, -y)), f"{ORDER}|mirror"),
    Mistake("arms 1.35 times", file(placed=lambda x, y: (1.35 * x, 1.35 * y)), "arm"),
    Mistake("mass 1.3 times", file(1.3), "mass|weigh"),
    Mistake("arms and mass 1.5 times", file(1.5, placed=lambda x, y: (1.5 * x, 1.5 * y)), "the arm .* and the mass"),
)


def orders(rotors: int) -> Iterator[Mistake]:
    """All orders of so many motors but the right one."""
    for order in permutations(range(rotors)):
        if order != tuple(range(rotors)):
            name = "".join(str(k + 1) for k in order)
            back = ", ".join(str(order.index(k) + 1) for k in range(rotors))
            yield Mistake(f"order {name}", columns(ROTORS, order), back)


# --- The table


def said(recording: Recording, vehicle: Vehicle) -> list[str]:
    """Lines that a user reads, in their order: the refusal of `load`, else errors and then warnings of `inspect`."""
    found = inspect(recording, vehicle)
    lines = [
        f"{check.message}; {check.fix}"
        for wanted in (CheckResult.ERROR, CheckResult.WARNING)
        for check in found.checks
        if check.verdict is wanted
    ]
    try:
        check_conventions(recording, vehicle, LogPart(Path("log")))
    except LogError as error:
        lines = [f"refused: {error.found}; {error.fix}", *lines]
    return lines


def judged(log: Log, mistake: Mistake, usual: Sequence[str]) -> tuple[str, str]:
    """Grade of an answer: the mistake is named or not; and the first line that the right log is not answered with."""
    known = {re.sub(r"[-0-9.e]+", "", line) for line in usual}
    lines = [line for line in said(*mistake.made(*log)) if re.sub(r"[-0-9.e]+", "", line) not in known]
    first = lines[0] if lines else ""
    if re.search(mistake.named, first):
        return "right", first
    return ("WRONG" if first else "silent"), first


def cells(name: str, data: Path, parts: Sequence[str] = (), every: bool = False) -> Iterator[tuple[str, str, str]]:
    """Mistake, verdict and first line for a vehicle; mistakes on channels that its log lacks are left out."""
    log = flown(name, data)
    usual = said(*log)
    more = orders(len(log[1].rotors)) if every and len(log[1].rotors) == 4 else ()
    for mistake in (*MISTAKES, *more):
        if parts and not any(part in mistake.name for part in parts):
            continue
        try:
            yield mistake.name, *judged(log, mistake, usual)
        except (KeyError, IndexError):
            continue


def main() -> int:
    """Prints or writes the table; the number of wrong cells is the exit code."""
    given = options(
        __doc__, words="parts of mistakes; all without", vehicles=",".join((*SIMULATED, *RECORDED)), orders=False
    )
    vehicles, found = given.vehicles.split(","), dict[str, dict[str, str]]()
    wrong, count = list[str](), Counter[str]()
    for vehicle in vehicles:
        for mistake, verdict, line in cells(vehicle, given.data, given.words, given.orders):
            found.setdefault(mistake, {})[vehicle] = verdict
            count[verdict] += 1
            wrong += [f"* {mistake}, {vehicle}: {line.replace('|', '/')[:200]}"] if verdict == "WRONG" else []
    rows = [(mistake, *(row.get(v, "–") for v in vehicles)) for mistake, row in found.items()]
    about = (
        "`make judging`: one mistake at a time on logs that are right; the first line that a user reads. *right*: it "
        "names the mistake; *silent*: nothing is said; –: the log has no such channel or rotor. "
        f"{count['right']} right, {count['silent']} silent, {count['WRONG']} wrong."
    )
    put(given, "judging.md", TITLE, "table", [about, "", *table(("mistake", *vehicles), rows), "", *wrong])
    return min(count["WRONG"], 99)


if __name__ == "__main__":
    sys.exit(main())
