"""What one step of the rollout is made of: each piece of the kernel alone, in a loop, beside the processor's peak."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np

from benchmarks.kernel import every_effect, particles, peak_case
from quadid.model import body_kernel, kernel, lag_kernel, rollout_kernel, rotor_kernel, sensor_kernel
from quadid.model.rows import A_G, ALL_MOMENTS, HALF, N_ROWS, ROTOR, X_QW
from quadid.model.simd import LANES, aligned
from quadid.vehicle import Vehicle

STEPS, ROWS, SLICE = 2000, 32, 0.03
"""Steps of a run; rows of data, which stay in cache; time a piece runs in a round [s]."""
PIECES = {
    "loop alone": "pass",
    "nominal step, moments shared": "step_core_shared(1e-4, table, k, s)",
    "nominal step": "step_core(1e-4, s)",
    "step with effects on the body alone": "step_solid(1e-4, s)",
    "step with rotor drag": "step_air(1e-4, s)",
    "step with rotor and parasitic drag": "step_air_rare(1e-4, s)",
    "step with rotor drag and the body": "step_air_solid(1e-4, s)",
    "full step": "step_full(1e-4, s)",
    "four rotors, held input": "rotors_step(u, slope, k, True, False, geometry, 0.02, rot, s)",
    "four rotors, delayed input": "rotors_step(u, slope, k, True, True, geometry, 0.02, rot, s)",
    "residual": "compare(0, 0, k, measured, scale, s, out)",
    "sum and projection": "collect(0, k, basis, out, total, inside, 9)",
    "IMU filter": "step_filter(0.02, s); use_filter(s)",
    "AHRS tilt error": "step_tilt_error(0.02, s); tilt_attitude(s)",
    "attitude delay, lanes alike": "remember_attitude(k, s, past); _look_up(k, k, 0.02, past, s); _turn_back(0.02, s)",
    "attitude delay, lanes differ": "remember_attitude(k, s, past); delay_attitude(k, 0.02, past, s)",
    "misalignment, scale, biases": "distort_imu(s)",
    "factors of thrust and mass": "flight_factors(0.02 * k, 0.0, 40.0, 0.02, s)",
}
ARGUMENTS = "s, table, u, slope, geometry, rot, measured, scale, out, basis, total, inside, past"


def pieces(rounds: int) -> dict[str, Any]:
    """Nanoseconds per particle of each piece, best of all rounds, and of one fused multiply-add at the peak."""
    arrays, state = _arrays()
    loops = {name: _loop(call) for name, call in PIECES.items()}
    peak = peak_case()
    best = dict.fromkeys([*loops, "peak"], np.inf)
    for turn in range(rounds + 1):
        for name, loop in loops.items():
            arrays[0][:] = state
            found = _best(lambda run=loop: run(STEPS, *arrays)) / (STEPS * LANES)  # type: ignore[misc]
            best[name] = min(best[name], found) if turn else np.inf
        best["peak"] = min(best["peak"], _best(peak.run) / peak.steps)
    idle = best["loop alone"]
    return {"ns": {n: 1e9 * (best[n] - idle) for n in loops if n != "loop alone"}, "fma_per_ns": 1e-9 / best["peak"]}


def _best(run: Callable[[], object]) -> float:
    end, best = time.perf_counter() + SLICE, np.inf
    while time.perf_counter() < end:
        begin = time.thread_time()
        run()
        best = min(best, time.thread_time() - begin)
    return best


def _loop(call: str) -> Any:
    """A compiled loop over steps that calls one piece."""
    scope: dict[str, Any] = {}
    for module in (kernel, body_kernel, rotor_kernel, lag_kernel, sensor_kernel, rollout_kernel):
        scope |= vars(module)
    source = f"def loop(steps, {ARGUMENTS}):\n    for i in range(steps):\n        k = i % {ROWS}\n        {call}\n"
    exec(source, scope)  # one source for all, so that nothing differs but the call
    return nb.njit(nogil=True)(scope["loop"])


def _arrays() -> tuple[list[Any], Any]:
    vehicle, rng = Vehicle.shipped("pelican"), np.random.default_rng(5)
    theta = every_effect(vehicle, particles(vehicle, LANES))
    rotors = len(vehicle.rotors)
    s, rot = aligned((N_ROWS * LANES,)), aligned((rotors, ROTOR))
    s[:] = 0.0
    s[A_G : A_G + 2 * LANES] = s[A_G + HALF : A_G + HALF + 2 * LANES] = 1.0
    s[X_QW : X_QW + LANES] = 1.0
    kernel.body_constants(theta, vehicle.mass, rotors, 0.1, s)
    sensor_kernel.sensor_constants(theta, 0.02, s)
    lag_kernel.rotor_constants(theta, 0.02, rot, s)
    u = np.full((ROWS, rotors), vehicle.hover_speed())
    rotor_kernel.rotors_start(u, 0, rot)
    geometry = np.column_stack([vehicle.rotor_positions[:, :2], vehicle.spins])
    room = [aligned(shape) for shape in ((1, 1, 15 * LANES), (LANES,), (6, LANES), (ROWS, 7, LANES))]
    for array in room:
        array[:] = 0.0
    out, total, inside, past = room
    data = [
        rng.random((ROWS, 2 * ALL_MOMENTS)),
        u,
        np.empty((0, rotors)),
        geometry,
        rot,
        rng.random((ROWS, 16)),
        np.ones((ROWS, 9)),
    ]
    return [s, *data, out, rng.random((1, 9 * ROWS, 6)), total, inside, past], s.copy()
