"""Effects outside the catalogue, which a diagnosis must call unknown: in flight and in the log."""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import cont2discrete, lfilter

from quadid.errors import ParameterError, nearest
from quadid.flight.airframe import PUSHES
from quadid.flight.loop import OnBoard, Plan, Track, attitude_at, read_accel, read_gyro
from quadid.flight.setup import Setup, vehicle_scales
from quadid.rotation import conjugate, continuous_sign, euler, exponential, product
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, RandomForces, Vehicle

# --- Outside effects that act in flight: structure, propulsion, environment, on-board software


@dataclass
class Scene:
    """A flight about to start.

    Attributes:
        arrival: when each command reaches the rotors [s].
        pushes: disturbance a step: specific force, world [m/s^2], angular acceleration and specific force, body
            [rad/s^2], [m/s^2]; shape (steps, 9), or (1, 9) while there is none.
    """

    setup: Setup
    plan: Plan
    arrival: FloatArray
    pushes: FloatArray

    @property
    def hover_speed(self) -> float:
        """Rotor speed in hover [rad/s]."""
        return self.setup.air.hover_sum / len(self.setup.vehicle.rotors)

    def push(self, columns: slice, values: FloatArray) -> None:
        """Adds a disturbance given at every step to some columns of `pushes`."""
        if len(self.pushes) != self.plan.steps:
            self.pushes = np.zeros((self.plan.steps, PUSHES))
        self.pushes[:, columns] += values


Values = Mapping[str, float]
Arrange = Callable[[Scene, Values, np.random.Generator], None]


def suspended_load(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Spherical pendulum of small swing hooked below the CG; its weight is part of the vehicle's mass."""
    scene.setup.odd = scene.setup.odd._replace(
        dynamic=True, load_share=v["share"], load_length=v["length"], load_damping=v["damping"], load_depth=v["depth"]
    )


def flexible_arm(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """A share of roll and pitch torque passes a lightly damped second-order resonance."""
    scene.setup.odd = scene.setup.odd._replace(
        dynamic=True, flex_share=v["share"], flex_speed=2.0 * np.pi * v["frequency"], flex_damping=v["damping"]
    )


def slosh(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Fluid as a spring-mounted mass that moves sideways in the body frame."""
    scene.setup.odd = scene.setup.odd._replace(
        dynamic=True,
        slosh_share=v["share"],
        slosh_speed=2.0 * np.pi * v["frequency"],
        slosh_damping=v["damping"],
        slosh_depth=v["depth"],
    )


def gimbal_torque(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Sinusoidal roll and pitch acceleration a quarter turn apart, from a random phase."""
    t = scene.plan.dt * np.arange(scene.plan.steps)
    angle = 2.0 * np.pi * v["frequency"] * t + rng.uniform(0.0, 2.0 * np.pi)
    scene.push(slice(3, 5), np.column_stack([v["roll"] * np.sin(angle), v["pitch"] * np.cos(angle)]))


def thrust_hysteresis(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Thrust is higher by the fraction after a rise of the command, lower after a fall."""
    scene.setup.drive = scene.setup.drive._replace(hysteresis=v["fraction"])


def esc_slew(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Limits the rate of rotor speed."""
    scene.setup.drive = scene.setup.drive._replace(slew=v["rate"] * scene.hover_speed)


def weak_supply(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """The supply gives way: above a knee every rotor only follows a share of the command."""
    scene.setup.drive = scene.setup.drive._replace(knee=v["knee"] * scene.hover_speed, above_knee=v["share"])


def esc_grain(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Rounds commands to multiples of a coarse step."""
    scene.setup.drive = scene.setup.drive._replace(grain=v["grain"] * scene.hover_speed)


def rotor_dropout(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """A random rotor loses thrust and drag torque for a while, again and again."""
    end = scene.plan.start + scene.plan.steps * scene.plan.dt
    times, t = [], float(rng.exponential(v["every"]))
    while t < end:
        length = v["lasts"] * float(rng.uniform(0.5, 1.5))
        times.append((t, t + length))
        t += length + float(rng.exponential(v["every"]))
    scene.setup.events = scene.setup.events._replace(
        faint_rotor=int(rng.integers(len(scene.setup.vehicle.rotors))),
        faint_share=v["share"],
        faint_times=np.array(times).reshape(-1, 2),
    )


def gusts(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Coloured noise of Dryden's form: first order along the world axes, second order in rotation."""
    n, dt = scene.plan.steps, scene.plan.dt
    pole = float(np.exp(-dt / v["time"]))
    gain = float(np.sqrt(1.0 - pole**2))
    push = lfilter([gain], [1.0, -pole], rng.standard_normal((n, 3)), axis=0)
    quick = float(np.exp(-dt / (0.3 * v["time"])))
    turn = lfilter([1.0], [1.0, -quick], lfilter([1.0], [1.0, -quick], rng.standard_normal((n, 3)), axis=0), axis=0)
    scene.push(slice(0, 3), v["push"] * push * np.array([1.0, 1.0, 0.5]))
    scene.push(slice(3, 6), v["turn"] * turn / np.std(turn) * np.array([1.0, 1.0, 0.3]))


def random_forces(scene: Scene, random: RandomForces, rng: np.random.Generator) -> None:
    """Random specific force and angular acceleration of a vehicle file, first order along the body axes."""
    sizes, times = random.each_axis
    for column, size, time in zip((6, 7, 8, 3, 4, 5), sizes, times, strict=True):
        pole = float(np.exp(-scene.plan.dt / time))
        noise = size * np.sqrt(1.0 - pole**2) * rng.standard_normal(scene.plan.steps)
        noise[0] = size * rng.standard_normal()  # begins as it goes on
        scene.push(slice(column, column + 1), lfilter([1.0], [1.0, -pole], noise)[:, None])


def transverse_flow(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Inflow that differs from side to side rolls a vehicle that flies diagonally."""
    scene.setup.odd = scene.setup.odd._replace(cross_roll=v["roll"])


def dead_time_jitter(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Adds a uniformly random delay to every command; a late one never overtakes the next."""
    late = scene.arrival + rng.uniform(0.0, v["jitter"], len(scene.arrival))
    scene.arrival = np.asarray(np.maximum.accumulate(late))


def lost_commands(scene: Scene, v: Values, rng: np.random.Generator) -> None:
    """Loses commands at random: the rotors keep the last one that came through."""
    lost = rng.random(len(scene.arrival)) < min(v["probability"], 0.9)
    lost[-1] = False
    following = np.where(lost, np.inf, scene.arrival)[::-1]
    scene.arrival = np.ascontiguousarray(np.minimum.accumulate(following)[::-1])


# --- Outside effects that act on the log: sensors and logging software


@dataclass
class LogRows:
    """A log about to be written, noise included.

    Attributes:
        gyro, accel, attitude: rows of the log; replaced by effects.
        steps: step numbers at which the rows were measured.
        track, plan, on_board: where they come from.
        thrust: sum of squared commanded rotor speeds over hover's, shape (rows,).
    """

    gyro: FloatArray
    accel: FloatArray
    attitude: FloatArray
    steps: FloatArray
    track: Track
    plan: Plan
    on_board: OnBoard
    thrust: FloatArray

    @property
    def t(self) -> FloatArray:
        """Times of the rows [s]."""
        return self.plan.dt * (self.steps - self.plan.first_log)


Distort = Callable[[LogRows, Values, np.random.Generator], None]


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def vibration_rectification(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Accelerometer offset that grows with the fourth power of rotor speed, in a random direction."""
    rows.accel = rows.accel + v["shift"] * np.outer(rows.thrust**2, _direction(rng))


def gyro_g_sensitivity(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro offset proportional to specific force, through a random matrix of unit spectral norm."""
    matrix = rng.standard_normal((3, 3))
    rows.gyro = rows.gyro + rows.accel @ (v["gain"] * matrix / np.linalg.norm(matrix, 2)).T


def gyro_warm_up(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro offset that settles exponentially."""
    rows.gyro = rows.gyro + v["shift"] * np.outer(1.0 - np.exp(-rows.t / v["time"]), _direction(rng))


def gyro_clipping(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Saturates every gyro axis."""
    rows.gyro = np.clip(rows.gyro, -v["limit"], v["limit"])


def accel_clipping(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Saturates every accelerometer axis."""
    rows.accel = np.clip(rows.accel, -v["limit"] * GRAVITY, v["limit"] * GRAVITY)


def _reread(rows: LogRows, track: Track, steps: FloatArray) -> None:
    """Replaces what the IMU measured by what it would have measured on `track` at `steps`; the noise stays."""
    for name, read in (("gyro", read_gyro), ("accel", read_accel)):
        was = read(rows.track, rows.plan, rows.on_board, np.inf, rows.steps)
        setattr(rows, name, getattr(rows, name) + read(track, rows.plan, rows.on_board, np.inf, steps) - was)


def _resonance(signal: FloatArray, speed: float, damping: float, dt: float) -> FloatArray:
    """Passes a signal through a unit-gain second-order resonance of natural frequency `speed` [rad/s]."""
    top, bottom, _ = cont2discrete(
        (np.array([speed**2]), np.array([1.0, 2.0 * damping * speed, speed**2])), dt, method="foh"
    )
    return np.asarray(lfilter(np.ravel(top), bottom, signal - signal[0], axis=0) + signal[0])


def loose_imu(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro and accelerometer ride on a lightly damped mount."""
    speed, dt = 2.0 * np.pi * v["frequency"], rows.plan.dt
    gyro = _resonance(rows.track.gyro, speed, v["damping"], dt)
    force = _resonance(np.diff(rows.track.accel, axis=0), speed, v["damping"], dt)
    track = rows.track._replace(gyro=gyro, accel=np.vstack([np.zeros(3), np.cumsum(force, axis=0)]))
    _reread(rows, track, rows.steps)


def compass_throttle(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Heading error proportional to the departure of thrust from hover."""
    half = 0.5 * v["gain"] * (rows.thrust - 1.0)
    turn = np.column_stack([np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)])
    rows.attitude = product(turn, rows.attitude)


def attitude_steps(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Rounds roll, pitch and yaw to multiples of a coarse step."""
    angles = np.rint(euler(rows.attitude) / v["step"]) * v["step"]
    roll, pitch, yaw = (exponential(angles * axis) for axis in np.eye(3))
    rows.attitude = continuous_sign(product(product(yaw, pitch), roll))


def clock_jitter(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Measures gyro, accelerometer and attitude at instants scattered about the stamped ones."""
    steps = rows.steps + np.clip(rng.normal(0.0, v["sigma"], len(rows.steps)), -0.01, 0.01) / rows.plan.dt
    before, after = attitude_at(rows.track, rows.steps), attitude_at(rows.track, steps)
    rows.attitude = continuous_sign(product(rows.attitude, product(conjugate(before), after)))
    _reread(rows, rows.track, steps)


def repeated_rows(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Repeats the sensor row before at random rows."""
    fresh = rng.random(len(rows.steps)) >= min(v["probability"], 0.9)
    fresh[0] = True
    source = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
    rows.gyro, rows.accel, rows.attitude = rows.gyro[source], rows.accel[source], rows.attitude[source]


def gyro_spikes(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Adds a large error of random direction to single gyro rows."""
    hit = rng.random(len(rows.steps)) < v["probability"]
    gyro = rows.gyro.copy()
    gyro[hit] += v["size"] * rng.choice([-1.0, 1.0], (int(hit.sum()), 3)) * rng.uniform(0.5, 1.0, (int(hit.sum()), 3))
    rows.gyro = gyro


# --- Effects OUTSIDE the catalogue: what no entry of `quadid.effects` explains, so that a diagnosis must answer
# "unknown"
#
# Each has a realistic size and a seed.  `arrange` changes the flight before take-off, `distort` the log afterwards.


class Size(NamedTuple):
    """Realistic range of one number on a Pelican.

    Attributes:
        low, high: range.
        scales: whether it grows with the effect (a frequency does not).
        by: key of `quadid.flight.setup.vehicle_scales`, for numbers that depend on the vehicle's size.
    """

    low: float
    high: float
    scales: bool = True
    by: str = ""


def _fixed(low: float, high: float, by: str = "") -> Size:
    return Size(low, high, False, by)


Sizes = dict[str, Size]
ARRANGE: dict[Arrange, Sizes] = {
    suspended_load: {  # length, depth [m]
        "share": Size(0.05, 0.12),
        "length": _fixed(0.5, 1.5),
        "damping": _fixed(0.04, 0.08),
        "depth": _fixed(0.02, 0.05, "lever"),
    },
    flexible_arm: {"share": Size(0.25, 0.5), "frequency": _fixed(6.0, 11.0), "damping": _fixed(0.05, 0.12)},  # [Hz]
    slosh: {  # [Hz], [m]
        "share": Size(0.05, 0.12),
        "frequency": _fixed(1.2, 2.2),
        "damping": _fixed(0.08, 0.15),
        "depth": _fixed(0.04, 0.08, "lever"),
    },
    gimbal_torque: {"roll": Size(0.5, 1.5), "pitch": Size(0.5, 1.5), "frequency": _fixed(0.6, 2.0)},  # [rad/s^2]
    thrust_hysteresis: {"fraction": Size(0.02, 0.06)},
    esc_slew: {"rate": _fixed(1.4, 2.2)},  # hover speeds per s; smaller is stronger
    weak_supply: {"knee": _fixed(0.98, 1.04), "share": _fixed(0.4, 0.7)},  # hover speeds; smaller is stronger
    esc_grain: {"grain": Size(0.03, 0.06)},  # hover speeds
    rotor_dropout: {"share": Size(0.08, 0.2, True, "balance"), "every": _fixed(5.0, 12.0), "lasts": _fixed(0.6, 2.0)},
    gusts: {"push": Size(0.3, 0.9), "turn": Size(0.4, 1.2), "time": _fixed(0.3, 1.0)},  # [m/s^2], [rad/s^2], [s]
    transverse_flow: {"roll": Size(0.3, 0.8)},  # [rad/m^2]
    dead_time_jitter: {"jitter": Size(0.02, 0.045)},  # [s]
    lost_commands: {"probability": Size(0.15, 0.4)},
}
"""Changes of a flight: the function, which names and describes the effect, and its numbers."""
DISTORT: dict[Distort, Sizes] = {
    vibration_rectification: {"shift": Size(0.3, 0.8)},  # [m/s^2]
    gyro_g_sensitivity: {"gain": Size(0.004, 0.012)},  # [rad s/m]
    gyro_warm_up: {"shift": Size(0.02, 0.06), "time": _fixed(20.0, 60.0)},  # [rad/s], [s]
    gyro_clipping: {"limit": _fixed(0.5, 0.8)},  # [rad/s]; smaller is stronger
    accel_clipping: {"limit": _fixed(1.03, 1.08)},  # g; smaller is stronger
    loose_imu: {"frequency": _fixed(5.0, 9.0), "damping": _fixed(0.06, 0.15)},  # [Hz]
    compass_throttle: {"gain": Size(0.4, 1.2)},  # [rad]
    attitude_steps: {"step": Size(0.02, 0.05)},  # [rad]
    clock_jitter: {"sigma": Size(0.004, 0.009)},  # [s]
    repeated_rows: {"probability": Size(0.1, 0.3)},
    gyro_spikes: {"probability": Size(0.01, 0.03), "size": _fixed(0.5, 2.0)},  # size [rad/s]
}
"""Changes of a log, likewise."""
OUTSIDE: dict[str, Sizes] = {act.__name__: sizes for act, sizes in (*ARRANGE.items(), *DISTORT.items())}
"""Numbers of every effect outside the catalogue, by its name."""


def _stream(name: str, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def draw_outside(name: str, seed: int, scale: float = 1.0, vehicle: Vehicle | None = None) -> dict[str, float]:
    """Draws the numbers of one outside effect at realistic size.

    Args:
        name: key of `OUTSIDE`.
        scale: multiplies those numbers that grow with the effect.
        vehicle: scales levers from a Pelican's; default a Pelican.

    Raises:
        ParameterError: unknown name.
    """
    if name not in OUTSIDE:
        raise ParameterError(f"unknown outside effect '{name}'", fix=nearest(name, OUTSIDE))
    rng, factors = _stream(name, seed), vehicle_scales(vehicle)
    return {
        key: float(rng.uniform(size.low, size.high) * (scale if size.scales else 1.0) * factors.get(size.by, 1.0))
        for key, size in OUTSIDE[name].items()
    }


def check_outside(outside: Mapping[str, Mapping[str, float]]) -> None:
    """Raises ParameterError unless every effect is known and has exactly its numbers."""
    for name, values in outside.items():
        if name not in OUTSIDE:
            raise ParameterError(f"unknown outside effect '{name}'", fix=nearest(name, OUTSIDE))
        sizes = OUTSIDE[name]
        if set(values) != set(sizes) or not all(np.isfinite(v) for v in values.values()):
            raise ParameterError(f"{name} with {dict(values)}", "finite values for " + ", ".join(sizes))


def apply_outside(scene: Scene, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Arranges all outside effects before take-off; changes `scene`."""
    arrange = {act.__name__: act for act in ARRANGE}
    for name in filter(arrange.__contains__, outside):
        arrange[name](scene, outside[name], _stream(name, seed))


def distort_log(rows: LogRows, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Distorts the log with all outside effects; changes `rows`."""
    distort = {act.__name__: act for act in DISTORT}
    for name in filter(distort.__contains__, outside):
        distort[name](rows, outside[name], _stream(name, seed))
