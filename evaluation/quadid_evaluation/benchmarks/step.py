"""Speed of `quadid.Simulator`: one vehicle and batches on one core, beside RotorPy's step.

    python -m quadid_evaluation.benchmarks.step

Times are the best of many short runs, since other programs only add to them.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import numpy as np

from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.step import RandomInputs, Simulator
from quadid.vehicle import Vehicle

DT, BATCH = 0.002, 4096


def best(run: Callable[[], object], calls: int) -> float:
    """Shortest time of one call [s]."""
    shortest = np.inf
    for _ in range(9):
        begin = time.perf_counter()
        for _ in range(calls):
            run()
        shortest = min(shortest, (time.perf_counter() - begin) / calls)
    return float(shortest)


def every_effect(vehicle: Vehicle, thetas: np.ndarray) -> np.ndarray:
    """Parameter vectors with every effect at its typical size."""
    out = thetas.copy()
    for entry in Layout(vehicle).entries.values():
        if entry.index > ix.JR and not entry.name.endswith(".time"):
            out[:, entry.index] = entry.typical
    return out


def rotorpy_step() -> float | None:
    """Time of one step of RotorPy's Hummingbird [s]; None where it is not installed."""
    try:
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError:
        return None
    craft = Multirotor(quad_params)
    state, control = craft.initial_state, {"cmd_motor_speeds": np.full(4, 350.0)}
    return best(lambda: craft.step(state, control, DT), 50)


def main() -> None:
    """Prints a line a case."""
    pelican = Vehicle.shipped("pelican")
    hover = np.full(4, pelican.hover_speed())
    one = Simulator(pelican)
    state = one.start(dt=DT)
    print(f"one vehicle, in place:         {1e6 * best(lambda: one.advance(state, hover, DT), 5000):8.1f} us a step")
    print(f"one vehicle, a new state:      {1e6 * best(lambda: one.step(state, hover, DT), 5000):8.1f} us a step")
    rows = np.tile(hover, (1000, 1))
    print(f"one vehicle, 1000 steps a run: {1e3 * best(lambda: one.run(state, rows, DT), 20):8.2f} us a step")
    nominal, commands = np.tile(Layout(pelican).initial(pelican), (BATCH, 1)), np.tile(hover, (BATCH, 1))
    random = RandomInputs((0.1, 0.1, 0.1), 1.0, (1.0, 1.0, 1.0), 0.5)
    for name, thetas, extra in (
        ("nominal", nominal, None),
        ("every effect, random inputs", every_effect(pelican, nominal), random),
    ):
        batch = Simulator(pelican, thetas, random=extra, span=60.0)
        flying = batch.start(dt=DT)
        each = best(functools.partial(batch.advance, flying, commands, DT), 5) / BATCH
        print(f"{BATCH} vehicles, {name}: {1e9 * each:.0f} ns a vehicle and step")
    if (peer := rotorpy_step()) is not None:
        print(f"RotorPy, one vehicle:          {1e6 * peer:8.1f} us a step")


if __name__ == "__main__":
    main()
