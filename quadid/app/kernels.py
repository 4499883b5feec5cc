"""The compiled kernels: which there are, whether this machine has them already, and short runs that compile them.

What calls the same pieces is one part, or each process would compile them again.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from quadid.app.outcome import Advance
    from quadid.data.window import Window
    from quadid.vehicle import Vehicle


class Part(NamedTuple):
    """Kernels that one process compiles.

    Attributes:
        run: calls each of them once, as a fit or a flight does.
        names: the functions on disk, each as the module of quadid and its name.
    """

    run: Callable[[], None]
    names: tuple[str, ...]

    def kernels(self) -> list[Any]:
        """The functions on disk."""
        return [resolve_name(f"quadid.{name}") for name in self.names]


def missing(names: tuple[str, ...]) -> list[str]:
    """Parts with a kernel that is not compiled for this machine and these sources."""
    return [name for name in names if not all(on_disk(kernel) for kernel in PARTS[name].kernels())]


def on_disk(kernel: Any) -> bool:
    """Checks whether machine code of a kernel, for this processor and this source, is in numba's cache."""
    from numba.core.registry import cpu_target

    cache = kernel._cache
    if not hasattr(cache, "_cache_file"):  # nothing can be written
        return True
    now = cache._index_key((), cpu_target.target_context.codegen())[1:]
    return any(key[1:] == now for key in cache._cache_file._load_index())


def _hover() -> tuple[Vehicle, Window]:
    """Half a second of standing still in the air, made up."""
    import numpy as np

    from quadid.data.window import Window
    from quadid.vehicle import GRAVITY, Vehicle

    vehicle = Vehicle.shipped("pelican")
    rows = 25
    attitude, accel, references = np.zeros((rows, 4)), np.zeros((rows, 3)), np.zeros((rows, 4))
    attitude[:, 0], accel[:, 2], references[:, 3] = 1.0, -GRAVITY, 0.5
    speed = np.full((rows, len(vehicle.rotors)), vehicle.hover_speed())
    return vehicle, Window(
        0.0, 0.02, speed, np.zeros((rows, 3)), attitude, accel, attitude_reference=references, sampling="held"
    )


def _simulation() -> None:
    from quadid.flight.pilot import default_gains
    from quadid.model.closed_loop import ClosedLoop
    from quadid.model.layout import Layout
    from quadid.model.rollout import Rollout, Segments

    vehicle, window = _hover()
    rollout = Rollout(window, vehicle)
    theta = Layout(vehicle).initial(vehicle)[None].repeat(2, axis=0)
    segments = Segments.cut(len(window), 10)
    states = rollout.initial_states(segments)
    rollout.roll(segments, theta, states)  # rotors do the same in both lanes: from a table
    theta[1, Layout(vehicle).entry("motor_lag.tau").index] = 0.02
    rollout.roll(segments, theta, states)
    ClosedLoop(window, vehicle, default_gains(vehicle)).fly(theta[:1])


def _estimate() -> None:
    import numpy as np

    from quadid.estimate import kalman
    from quadid.estimate.problem import Problem
    from quadid.estimate.track import from_window

    vehicle, window = _hover()
    track = from_window(window, vehicle)
    problem = Problem.of([track], vehicle)
    p, psi = problem.physics(problem.start(), 0), problem.first_noise()
    _, gains = kalman.kalman(track, p, psi)
    kalman.replay(track, p, psi, gains, gains.table, np.empty((len(track.t), kalman.M)))
    kalman.backward(track, p, psi, gains, True)


def _flight() -> None:
    from quadid.flight import fly

    fly(_hover()[0], seconds=0.5)


PARTS = {
    "simulation": Part(
        _simulation,
        ("model.rollout_kernel:roll_segments", "model.rotor_kernel:rotor_table", "model.closed_loop:fly_closed_loop"),
    ),
    "estimate": Part(
        _estimate, tuple(f"estimate.kalman:{name}" for name in ("moments", "filter_pass", "replay", "backward"))
    ),
    "flight": Part(_flight, ("flight.fly:march",)),
}
"""Kernels of an identification or a diagnosis, in two parts, and the flown vehicle of `quadid simulate`."""
FIT = ("simulation", "estimate")


# --- Compiling what a command needs before it works, in processes side by side


STAGE = "compiling, once on this machine"
_CHILD = "import gc; gc.disable(); from quadid.app.kernels import PARTS; PARTS[{!r}].run()"
"""A compiler makes many objects that live on: looking through them takes a tenth of its time."""


def prepare(parts: Sequence[str], advance: Advance) -> list[str]:
    """Compiles what is missing of these parts of `quadid.app.kernels`, a process each; returns which were.

    Compiling holds a lock within a process, so only processes make use of more than one core.  What a process fails
    to compile, the work itself compiles, and says why it cannot.
    """
    wanted = missing(tuple(parts))
    kernels = [kernel for name in wanted for kernel in PARTS[name].kernels()]
    children = [
        subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD.format(name)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for name in wanted
    ]
    while any(child.poll() is None for child in children):
        advance(STAGE, sum(map(on_disk, kernels)) / len(kernels))
        time.sleep(0.2)
    return wanted
