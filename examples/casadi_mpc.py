"""From a log to a predictive controller: the identified Pelican flies a fast circle, with CasADi and its own solvers.

    pip install 'quadid[casadi]'
    python examples/casadi_mpc.py              # a minute or two: flies a log, diagnoses it, flies two controllers

Both controllers are the same but for the vehicle file: one has the guesses that the log was identified from, one what
`quadid.diagnose` found in it.  The truth is the flown vehicle of `quadid.flight`, which shares no equation with either.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import quadid
from quadid import symbolic
from quadid.flight import SteppedFlight

HIDDEN = {"motor_lag": {"tau": 0.05}, "rotor_drag": {"k_x": 0.3, "k_y": 0.3}}
PERIOD, RADIUS, HEIGHT = 3.0, 2.0, 30.0  # of the circle [s], [m], [m]: 4 m/s and 42 degrees of tilt
STEP, AHEAD = 0.04, 15  # of the prediction [s], and how many
WEIGHTS = {"gentle": (10.0, 1.0, 0.05, 0.5), "firm": (40.0, 2.0, 0.02, 0.05)}
"""Of the squared misses of position [1/m^2] and velocity, of rates, and of rotor speeds beside hover."""


def wanted(t: Any) -> Any:
    """Position and velocity on the circle, entered softly, shape (6, ...)."""
    w, grow = 2.0 * np.pi / PERIOD, 1.0 - np.exp(-t)
    sin, cos, zero = np.sin(w * t), np.cos(w * t), 0.0 * t
    speed = np.array([grow * w * cos + np.exp(-t) * sin, -grow * w * sin + np.exp(-t) * (cos - 1.0), zero])
    return np.concatenate([np.array([RADIUS * grow * sin, RADIUS * grow * (cos - 1.0), zero - HEIGHT]), RADIUS * speed])


class Controller:
    """Nonlinear predictive control by multiple shooting."""

    def __init__(self, vehicle: quadid.Vehicle, weights: tuple[float, ...]) -> None:
        model, n = symbolic.model(vehicle), len(vehicle.rotors)
        self.size, self.hover, step = len(model.states), vehicle.hover_speed(), model.step(STEP)
        X, U = ca.MX.sym("X", self.size, AHEAD + 1), ca.MX.sym("U", n, AHEAD)
        x0, goal = ca.MX.sym("x0", self.size), ca.MX.sym("goal", 6, AHEAD)
        cost, gaps = 0.0, [X[:, 0] - x0]
        for k in range(AHEAD):
            now, u = X[:, k + 1], U[:, k] / self.hover - 1.0
            miss, heading = ca.vertcat(now[10:13], now[7:10]) - goal[:, k], 2.0 * (now[1] * now[2] + now[0] * now[3])
            terms = (ca.sumsqr(miss[:3]), ca.sumsqr(miss[3:]), ca.sumsqr(now[4:7]), ca.sumsqr(u))
            cost += 5.0 * heading**2 + sum(w * term for w, term in zip(weights, terms, strict=True))
            gaps.append(now - step(x=X[:, k], u=U[:, k], p=ca.DM(0, 1))["next"])
        problem = {"x": ca.veccat(X, U), "f": cost, "g": ca.veccat(*gaps), "p": ca.veccat(x0, goal)}
        options = {
            "ipopt.print_level": 0,
            "print_time": False,
            "expand": True,
            "ipopt.sb": "yes",
            "ipopt.max_iter": 30,
            "ipopt.tol": 1e-4,
            "ipopt.warm_start_init_point": "yes",
        }
        self.solver, self.guess = ca.nlpsol("mpc", "ipopt", problem, options), None
        free = np.full(X.numel(), np.inf)
        self.low = np.concatenate([-free, np.full(U.numel(), 0.3 * self.hover)])
        self.high = np.concatenate([free, np.full(U.numel(), 1.8 * self.hover)])

    def __call__(self, flight: SteppedFlight) -> Any:
        """Rotor speeds [rad/s] to command now."""
        state = np.concatenate([flight.quaternion, flight.rate, flight.velocity, flight.position, flight.rotor_speed])
        state = state[: self.size]
        if self.guess is None:
            start = np.tile(state, AHEAD + 1)
            self.guess = np.concatenate([start, np.full(AHEAD * len(flight.rotor_speed), self.hover)])
        goal = wanted(flight.time + STEP * (1 + np.arange(AHEAD)))
        found = self.solver(
            x0=self.guess, p=np.concatenate([state, goal.T.ravel()]), lbx=self.low, ubx=self.high, lbg=0.0, ubg=0.0
        )
        self.guess = np.array(found["x"]).ravel()
        at = self.size * (AHEAD + 1)
        return self.guess[at : at + len(flight.rotor_speed)]


def circled(vehicle: quadid.Vehicle, base: quadid.Vehicle, weights: tuple[float, ...], seconds: float) -> Any:
    """Distances from the circle [m] of the truth under the controller that believes in `vehicle`, at 50 Hz."""
    control, flight, missed = Controller(vehicle, weights), SteppedFlight(base, effects=HIDDEN, height=HEIGHT), []
    while flight.time < seconds - 1e-9:
        flight.step(control(flight), 0.02)
        missed.append(np.linalg.norm(flight.position - wanted(flight.time)[:3]))
    return np.array(missed)


def main() -> None:
    """Flies a log of the truth, finds what the file lacks, and flies the circle with and without it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=9.0, help="of the circle")
    seconds, guess = parser.parse_args().seconds, quadid.Vehicle.shipped("pelican")
    effects = [f"{name}:{','.join(f'{k}={v}' for k, v in values.items())}" for name, values in HIDDEN.items()]
    with tempfile.TemporaryDirectory() as folder:
        log = quadid.simulate(seconds=60.0, effects=effects, extras=["velocity"]).save(Path(folder) / "flight.mcap")
        found = quadid.diagnose(log, vehicle=guess).vehicle
    print("found:", ", ".join(f"{name} {dict(numbers)}" for name, numbers in found.effects.items()), "\n")
    print("| weights | controller believes in | rms distance [m] | largest [m] |\n|---|---|---|---|")
    for kind, weights in WEIGHTS.items():
        for name, vehicle in (("the guesses of the file", guess), ("the identified file", found)):
            missed = circled(vehicle, guess, weights, seconds)
            print(f"| {kind} | {name} | {np.sqrt(np.mean(missed**2)):.3f} | {missed.max():.3f} |", flush=True)


if __name__ == "__main__":
    main()
