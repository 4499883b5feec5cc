"""Speed of the simulation kernel in nanoseconds per particle-step, against NumPy and against the processor's peak.

    python -m quadid_evaluation.benchmarks.kernel --out docs/results

One particle-step is one parameter vector simulated over one sample at 50 Hz: rotors, Runge-Kutta step, sensors,
residual.  Times are the best of many short runs, in rounds over all cases, since other programs only ever add to them.
The NumPy step does the nominal model's step alone, vectorised over particles, and is checked against the kernel first.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numba as nb
import numpy as np

from quadid.data.window import Window
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.simd import LANES, aligned, lane_kernel, whole
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

SECONDS, RATE, LENGTH = 40, 50, 50
PEAK_ROUNDS, PEAK_CHAINS, PEAK_DEPTH = 2000, 12, 16
NOMINAL_OPERATIONS = 190 + 35
"""Additions, multiplications and fused pairs per particle in the compiled nominal step and comparison."""


@dataclass
class Case:
    """Something to be timed: `run` does `steps` particle-steps (or operations); `shortest` is its best time [s]."""

    name: str
    steps: int
    run: Callable[[], object]
    shortest: float = np.inf

    def time(self, seconds: float) -> None:
        """Runs for a while and keeps the best time of one run."""
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            start = time.perf_counter()
            self.run()
            self.shortest = min(self.shortest, time.perf_counter() - start)

    @property
    def ns(self) -> float:
        """Nanoseconds per step."""
        return 1e9 * self.shortest / self.steps


def recorded(vehicle: Vehicle, channels: int) -> Window:
    """A window of lively rotor speeds and noise for measurements: the kernel's speed does not depend on values."""
    rng = np.random.default_rng(1)
    n = SECONDS * RATE
    rotor_speed = vehicle.hover_speed() * (1.0 + 0.02 * rng.standard_normal((n, len(vehicle.rotors))))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    gyro, accel, velocity, position = 0.1 * rng.standard_normal((4, n, 3))
    motion = channels > 9
    return Window(
        0.0, 1.0 / RATE, rotor_speed, gyro, level, accel, velocity if motion else None, position if motion else None
    )


def particles(vehicle: Vehicle, m: int) -> FloatArray:
    """Parameter vectors scattered about the vehicle file's, shape (m, size)."""
    rng = np.random.default_rng(2)
    thetas = np.tile(Layout(vehicle).initial(vehicle), (m, 1))
    thetas[:, :6] *= np.exp(0.1 * rng.standard_normal((m, 6)))
    return thetas


def free(thetas: FloatArray, *entries: tuple[int, float]) -> FloatArray:
    """Parameter vectors with each of these effects at its own value in every one."""
    rng = np.random.default_rng(3)
    out = thetas.copy()
    for index, size in entries:
        out[:, index] = size * rng.uniform(0.5, 1.5, len(out))
    return out


LAG, DELAY, SAG = (ix.TAU, 0.02), (ix.DELAY, 0.02), (ix.SAG, 0.1)
DRAG = ((ix.KX, 0.2), (ix.KY, 0.2))


def every_effect(vehicle: Vehicle, thetas: FloatArray) -> FloatArray:
    """Parameter vectors with all effects of the catalogue."""
    entries = Layout(vehicle).entries.values()
    return free(thetas, *((e.index, e.typical) for e in entries if e.index > ix.JR and not e.name.endswith(".time")))


def model_cases(name: str, vehicle: Vehicle, thetas: FloatArray, channels: int, score: bool) -> tuple[Case, Case]:
    """Residuals (`roll` into memory in use) or the swarm's cost (`costs`), on one core and on all."""
    rollout = Rollout(recorded(vehicle, channels), vehicle)
    segments = Segments.cut(len(rollout), LENGTH)
    x0 = rollout.initial_states(segments)
    steps = len(segments.starts) * (LENGTH + 1)
    weights = np.ones((len(rollout), channels))
    directions = 6 if channels == 9 else 12
    shape = (len(segments.starts), LENGTH * channels, directions)
    basis = np.linalg.qr(np.random.default_rng(4).standard_normal(shape))[0]

    def case(vectors: FloatArray) -> Case:
        if score:
            return Case(name, steps * len(vectors), lambda: rollout.costs(segments, vectors, x0, weights, basis))
        out = rollout.roll(segments, vectors, x0)
        return Case(name, steps * len(vectors), lambda: rollout.roll(segments, vectors, x0, out=out))

    return case(thetas[:LANES]), case(thetas)  # a single block of lanes stays on the calling thread


# --- the same nominal step in NumPy


def numpy_step(x: FloatArray, theta: FloatArray, moments: FloatArray, mass: float, dt: float) -> FloatArray:
    """One Runge-Kutta step of attitude and rate, Eqs. 1 and 9, all particles at once.

    Args:
        x: quaternion and rate, shape (7, particles); advanced in place.
        theta: b, d, J_xx, J_yy, J_zz, J_r, shape (6, particles).
        moments: sums over rotors of omega^2, x omega^2, y omega^2, spin omega^2, spin omega.
        mass: mass [kg].
        dt: step [s].

    Returns:
        Specific force along z [m/s^2], shape (particles,).
    """
    b, d, jx, jy, jz, jr = theta
    roll, pitch, yaw, spin = -b * moments[2], b * moments[1], d * moments[3], jr * moments[4]

    def slope(y: FloatArray) -> FloatArray:
        w, i, j, k, p, q, r = y
        return np.stack([
            -0.5 * (i * p + j * q + k * r), 0.5 * (w * p + j * r - k * q), 0.5 * (w * q + k * p - i * r),
            0.5 * (w * r + i * q - j * p), ((jy - jz) * q * r + roll + spin * q) / jx,
            ((jz - jx) * p * r + pitch - spin * p) / jy, ((jx - jy) * p * q + yaw) / jz,
        ])  # fmt: skip

    k1 = slope(x)
    k2 = slope(x + 0.5 * dt * k1)
    k3 = slope(x + 0.5 * dt * k2)
    k4 = slope(x + dt * k3)
    x += dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    x[:4] *= 1.5 - 0.5 * np.sum(x[:4] ** 2, axis=0)
    return np.asarray(-b * moments[0] / mass)


def numpy_moments(vehicle: Vehicle, speeds: FloatArray) -> FloatArray:
    """Rotor sums of every row, shape (n, 5)."""
    square = speeds**2
    x, y = vehicle.rotor_positions[:, 0], vehicle.rotor_positions[:, 1]
    return np.column_stack([square.sum(axis=1), square @ x, square @ y, square @ vehicle.spins, speeds @ vehicle.spins])


def numpy_case(vehicle: Vehicle, thetas: FloatArray) -> Case:
    """The NumPy step, once it has been checked against the kernel."""
    window = recorded(vehicle, 9)
    moments, theta = numpy_moments(vehicle, window.rotor_speed), np.ascontiguousarray(thetas[:, :6].T)
    rollout, segments = Rollout(window, vehicle), Segments(LENGTH, 1, np.array([1]))
    start = rollout.initial_states(segments)
    x = np.tile(start[0, :7, None], (1, len(thetas)))
    for k in range(LENGTH + 1):
        numpy_step(x, theta, moments[k], vehicle.mass, window.dt)
    ends = rollout.roll(segments, thetas, start)[1]
    ends = np.moveaxis(ends, -1, 1).reshape(-1, *ends.shape[1:3])[: len(thetas), 0, :7]
    worst = float(np.abs(ends - x.T).max())
    if worst > 1e-9:
        raise AssertionError(f"NumPy and the kernel differ by {worst:g}")

    def run() -> None:
        y = np.tile(start[0, :7, None], (1, len(thetas)))
        for k in range(20):
            numpy_step(y, theta, moments[k], vehicle.mass, window.dt)

    return Case(f"NumPy, nominal step alone, {len(thetas)} particles", 20 * len(thetas), run)


# --- the processor's peak


def _peak_source() -> str:
    lines = [
        "def peak(rounds, a, x):",
        "    lane_kernel()",
        "    for _ in range(rounds):",
        "        for lane in range(8):",
    ]
    lines += [f"            c{j} = x[{8 * j} + lane]" for j in range(PEAK_CHAINS)]
    lines += [f"            c{j} = c{j} * a + 0.5" for _ in range(PEAK_DEPTH) for j in range(PEAK_CHAINS)]
    lines += [f"            x[{8 * j} + lane] = c{j}" for j in range(PEAK_CHAINS)]
    return "\n".join(lines)


def peak_case() -> Case:
    """Fused multiply-adds of float64 on one core: independent chains that stay in registers."""
    scope: dict[str, object] = {"lane_kernel": lane_kernel}
    exec(_peak_source(), scope)  # written out, because there are no loops over registers
    peak = nb.njit(**whole)(scope["peak"])
    x = aligned((8 * PEAK_CHAINS,))
    x[:] = 0.0
    return Case("peak", PEAK_ROUNDS * PEAK_CHAINS * PEAK_DEPTH * 8, lambda: peak(PEAK_ROUNDS, 0.5, x))


def all_model_cases(vehicle: Vehicle, m: int) -> list[tuple[Case, Case]]:
    """Every line of the table that times the model."""
    nominal = particles(vehicle, m)
    lines: list[tuple[str, FloatArray, int]] = [
        ("nominal", nominal, 9),
        ("motor lag, one a particle", free(nominal, LAG), 9),
        ("motor lag and delay", free(nominal, LAG, DELAY), 9),
        ("rotor drag", free(nominal, *DRAG), 9),
        ("rotor drag, lag, delay, sag", free(nominal, *DRAG, LAG, DELAY, SAG), 9),
        ("every effect", every_effect(vehicle, nominal), 9),
        ("every effect, velocity and position", every_effect(vehicle, nominal), 15),
    ]
    return [
        model_cases(name + (", cost" if score else ""), vehicle, thetas, channels, score)
        for score in (False, True)
        for name, thetas, channels in lines
    ]


def main() -> None:
    """Prints the table; writes it as JSON too when asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for kernel.json")
    parser.add_argument("--particles", type=int, default=8 * LANES)
    parser.add_argument("--rounds", type=int, default=8)
    arguments = parser.parse_args()
    vehicle = Vehicle.shipped("pelican")
    model = all_model_cases(vehicle, arguments.particles)
    plain = [numpy_case(vehicle, particles(vehicle, m)) for m in (64, 256, 4096)]
    peak = peak_case()
    for _ in range(arguments.rounds):
        for case in (*(c for pair in model for c in pair), *plain, peak):
            case.time(0.15)
    print(f"{'ns per particle-step':45s}{'one core':>12s}{'all cores':>12s}")
    for one, every in model:
        print(f"{one.name:45s}{one.ns:12.1f}{every.ns:12.1f}")
    for case in plain:
        print(f"{case.name:45s}{case.ns:12.1f}")
    nominal = model[0][0].ns
    share, gain = NOMINAL_OPERATIONS * peak.ns / nominal, min(case.ns for case in plain) / nominal
    print(f"\npeak of this processor, one core: {1.0 / peak.ns:.1f} fused multiply-adds of float64 per ns")
    print(f"the nominal rollout keeps {share:.0%} of it busy; NumPy at its best takes {gain:.0f} times as long")
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        timings = [{"name": one.name, "one_core": one.ns, "all_cores": every.ns} for one, every in model]
        result = {
            "schema": "quadid.benchmark.kernel/1", "rate": RATE, "lanes": LANES, "cores": os.cpu_count(),
            "particles": arguments.particles, "fma_per_ns": 1.0 / peak.ns, "share_of_peak": share,
            "timings": timings, "numpy": {case.name: case.ns for case in plain}, "gain_over_numpy": gain,
        }  # fmt: skip
        (arguments.out / "kernel.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
