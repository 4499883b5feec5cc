"""Poles of known systems found by CVA and MOESP, with and without feedback, and their prediction of flights.

    python -m quadid_evaluation.studies.subspace --seeds 20 --out docs/results

Systems: a resonance with a lag (two inputs, two outputs); two masses and three springs, the textbook's fourth-order
example, sampled at 10 Hz; an unstable plant under the controller that keeps it.  Flights: three simulated Pelicans of
500 s under the stabiliser, the first fitted, all scored as the physical model is.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from quadid.flight import fly
from quadid.identification.noise import NoiseModel
from quadid.types import ComplexArray, FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, table
from quadid_evaluation.paper.black_box import FEEDTHROUGH, BlackBox, quadrotor_io, score_black_box
from quadid_evaluation.paper.subspace import METHODS, Loop, fit_subspace

LOOPS: tuple[Loop, Loop] = ("closed", "open")
ALLOWED = 0.01
ROWS = 4000
PAST, FUTURE = 15, 8


class System(NamedTuple):
    """x[k+1] = A x + B u + K e, y = C x + e; the input is gain y + dither."""

    name: str
    A: FloatArray
    B: FloatArray
    C: FloatArray
    K: FloatArray
    feedback: float = 0.0
    dither: float = 1.0

    def run(self, rng: np.random.Generator, rows: int, noise: float) -> tuple[FloatArray, FloatArray]:
        """Inputs and outputs; `noise` is the standard deviation of e relative to that of the undisturbed output."""
        m, p = self.B.shape[1], len(self.C)
        push = self.dither * rng.standard_normal((rows, m))
        size = 1.0 if self.feedback else self._march(push, np.zeros((rows, p)))[1].std(axis=0)
        return self._march(push, noise * size * rng.standard_normal((rows, p)))

    def _march(self, push: FloatArray, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, u, y = np.zeros(len(self.A)), np.empty_like(push), np.empty_like(e)
        for k in range(len(push)):
            y[k] = self.C @ x + e[k]
            u[k] = self.feedback * y[k] + push[k] if self.feedback else push[k]
            x = self.A @ x + self.B @ u[k] + self.K @ e[k]
        return u, y

    def pole_error(self, poles: ComplexArray) -> float:
        """Largest distance of a pole from the true one, relative to its magnitude."""
        true = np.sort_complex(np.linalg.eigvals(self.A).astype(np.complex128))
        return float(np.max(np.abs(np.sort_complex(poles) - true) / np.abs(true)))


def resonance() -> System:
    """A resonance of radius 0.9 and a lag of 0.7."""
    c, s = 0.9 * np.cos(0.4), 0.9 * np.sin(0.4)
    return System(
        "resonance and lag, 2 × 2",
        np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 0.7]]),
        np.array([[1.0, 0.2], [-0.5, 0.8], [0.3, 1.0]]),
        np.array([[1.0, 0.3, -0.5], [0.2, -1.0, 0.8]]),
        0.1 * np.array([[1.0, 0.5], [-0.3, 0.4], [0.2, 0.6]]),
    )


def two_masses() -> System:
    """Two masses of 1 kg between walls, a force on each: springs 6, 4, 6 N/m, dampers 0.6, 0.4, 0.6 N s/m, 10 Hz."""
    stiff, soft = np.array([[10.0, -4.0], [-4.0, 10.0]]), np.array([[1.0, -0.4], [-0.4, 1.0]])
    continuous = np.zeros((6, 6))
    continuous[:2, 2:4], continuous[2:4, :2], continuous[2:4, 2:4] = np.eye(2), -stiff, -soft
    continuous[2:4, 4:] = np.eye(2)
    sampled = expm(0.1 * continuous)
    return System("two masses, 4th order", sampled[:4, :4], sampled[:4, 4:], np.eye(2, 4), np.zeros((4, 2)))


def unstable(dither: float) -> System:
    """A pole at 1.1, held by u = -0.5 y, with white dither of standard deviation `dither`."""
    one = np.ones((1, 1))
    return System(f"pole at 1.1 under feedback, dither {dither:g}", 1.1 * one, one, one, 0.5 * one, -0.5, dither)


def poles(seeds: int) -> list[str]:
    """Markdown rows: pole errors of every system, method and form."""
    rows = []
    for system, noise, count in (
        (resonance(), 0.1, ROWS),
        (two_masses(), 0.1, ROWS),
        (unstable(3.0), 1.0, 2 * ROWS),
        (unstable(0.3), 1.0, 2 * ROWS),
    ):
        data = [system.run(np.random.default_rng([seed, 3]), count, noise) for seed in range(seeds)]
        how = (len(system.A), PAST, FUTURE)
        for method in METHODS:
            cells = [f"{system.name}, {noise:.0%} noise", method]
            for loop in LOOPS:
                models = [fit_subspace(method, u, y, *how, loop, not system.feedback) for u, y in data]
                errors = np.array([system.pole_error(m.poles) for m in models])
                inside = int(np.count_nonzero(errors < ALLOWED))
                cells.append(f"{100 * np.median(errors):.3f}, {100 * errors.max():.3f}, {inside}/{seeds}")
            rows.append(cells)
    return table(("system", "method", *LOOPS), rows)


def flights(seconds: float, orders: tuple[int, ...]) -> list[str]:
    """Markdown rows: prediction of three flights over 1 s, error over that of a perfect physical model."""
    pelican, noise = Vehicle.shipped("pelican"), NoiseModel.guess(9)
    windows = [fly(pelican, seconds=seconds, seed=seed).window for seed in (1, 2, 3)]
    inputs, outputs = quadrotor_io(windows[0])

    def cell(method: str, order: int, loop: Loop) -> str:
        box = BlackBox(fit_subspace(method, inputs, outputs, order, loop=loop, feedthrough=FEEDTHROUGH), 1)
        return ", ".join(f"{score_black_box(box, [w], pelican, noise):.2f}" for w in windows)

    rows = [
        (f"{method}, {order}", *(cell(method, order, loop) for loop in LOOPS)) for order in orders for method in METHODS
    ]
    return table(("method, order", f"sets 1 (train), 2, 3: {LOOPS[0]}", *LOOPS[1:]), rows)


if __name__ == "__main__":
    given = options(__doc__, seeds=20, seconds=500.0)
    lines = [
        "# CVA and MOESP: poles of known systems, prediction of flights",
        "",
        f"`python -m quadid_evaluation.studies.subspace --seeds {given.seeds} --seconds {given.seconds:g} "
        f"--out docs/results`",
        "",
        "## Poles",
        "",
        f"{ROWS} rows a record ({2 * ROWS} under feedback); noise: innovations relative to the output without them. "
        "The order is given. Median and largest pole error [%], records within 1 %. quadid uses the form `closed`.",
        "",
        *poles(given.seeds),
        "",
        "## Flights",
        "",
        f"Three simulated Pelican flights of {given.seconds:g} s under the stabiliser, fitted on the first; mean "
        "squared error over 1 s relative to a perfect physical model.",
        "",
        *flights(given.seconds, (12, 22)),
    ]
    print(*lines, sep="\n")
    if given.out is not None:
        (given.out / "subspace.md").write_text("\n".join([*lines, ""]), encoding="utf-8")
