"""Outside effects that act in flight: structure, propulsion, environment, on-board software."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from quadid.flight.loop import Plan
from quadid.flight.setup import Setup
from quadid.types import FloatArray


@dataclass
class Scene:
    """A flight about to start.

    Attributes:
        setup: constants of the kernel.
        plan: clock.
        arrival: when each command reaches the rotors [s].
        pushes: disturbance a step: specific force, world [m/s^2], and angular acceleration, body [rad/s^2]; shape
            (steps, 6), or (1, 6) while there is none.
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
            self.pushes = np.zeros((self.plan.steps, 6))
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
