"""A Gymnasium environment whose every episode flies another vehicle of the fit, and a policy that learns in it.

    pip install 'quadid[gym]'
    python examples/gym_hover.py               # under a minute: a fit, then the learning curve

The learner is augmented random search (Mania et al. 2018, arXiv:1803.07055) on a linear policy: numpy alone.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import quadid

DT, STEPS = 0.02, 100  # of the control [s], and of an episode


class Hover(gymnasium.Env):
    """Come to rest at a place from somewhere near, with whichever vehicle `fit.sample` drew."""

    def __init__(self, vehicle: quadid.Vehicle, thetas: Any) -> None:
        self.vehicles = [quadid.Simulator(vehicle, theta) for theta in thetas]
        arms = vehicle.torque_arms / np.abs(vehicle.torque_arms).max(axis=0)
        self.mix = np.linalg.pinv(np.vstack([np.ones(len(arms)), arms.T])) * len(arms) / 2.0
        self.hover, high = vehicle.hover_speed(), np.full(12, np.inf, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))  # thrust, roll, pitch, yaw about hover

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        r = self.np_random
        self.now = self.vehicles[r.integers(len(self.vehicles))]
        attitude = np.append(1.0, 0.15 * r.standard_normal(3))
        moving = {name: 0.5 * r.standard_normal(3) for name in ("rate", "velocity", "position")}
        self.state = self.now.start(attitude=attitude, dt=DT, **moving)
        self.left = STEPS
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        lift = 1.0 + 0.5 * self.mix @ np.clip(action, -1.0, 1.0)
        self.now.advance(self.state, self.hover * np.sqrt(np.clip(lift, 0.05, 4.0)), DT)
        seen, self.left = self._seen(), self.left - 1
        lost = bool(np.abs(seen[:3]).max() > 3.0 or np.abs(seen[6:8]).max() > 1.5)
        reward = 0.0 if lost else float(np.exp(-(seen[:3] @ seen[:3]) - 0.1 * (seen[3:6] @ seen[3:6])))
        return seen, reward, lost, self.left == 0, {}

    def _seen(self) -> Any:
        s = self.state
        q = s.attitude[0]
        tilt = 2.0 * np.copysign(1.0, q[0]) * q[1:]
        return np.concatenate([s.position[0], s.velocity[0], tilt, s.rate[0]]).astype(np.float32)


SCALE = np.repeat([1.0, 1.0, 0.3, 1.0], 3)  # usual sizes of what is seen


def flown(env: Hover, policy: Any, seed: int) -> float:
    """Return of an episode, at most `STEPS`."""
    seen, total, over = env.reset(seed=seed)[0], 0.0, False
    while not over:
        seen, reward, lost, late, _ = env.step(policy @ (seen / SCALE))
        total, over = total + reward, lost or late
    return total


def learn(env: Hover, rounds: int, seed: int = 0, size: float = 0.2, rate: float = 0.2) -> tuple[Any, list[float]]:
    """A linear policy by augmented random search, and its mean return from the same five starts after every round."""
    rng, policy, curve = np.random.default_rng(seed), np.zeros((4, 12)), []
    for k in range(rounds):
        tries = rng.standard_normal((8, *policy.shape))
        signed = [[policy + sign * size * one for sign in (1.0, -1.0)] for one in tries]
        starts = range(100 + 10 * k, 103 + 10 * k)
        pairs = np.array([[np.mean([flown(env, p, e) for e in starts]) for p in pair] for pair in signed])
        uphill = np.mean((pairs[:, 0] - pairs[:, 1])[:, None, None] * tries, axis=0)
        policy = policy + rate * (1.0 - k / rounds) / pairs.std() * uphill
        curve.append(float(np.mean([flown(env, policy, e) for e in range(5)])))
    return policy, curve


def main() -> None:
    """Fits a flight, draws vehicles, learns, and tries the policy on vehicles that it never flew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=60)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder:
        fit = quadid.identify(quadid.simulate(seconds=60.0).save(Path(folder) / "flight.mcap"), vehicle="pelican")
    drawn = fit.sample(40, seed=1)[0]
    policy, curve = learn(Hover(fit.vehicle, drawn[:20]), rounds)
    for k in range(0, rounds, max(rounds // 10, 1)):
        print(f"round {k:4d}: mean return {curve[k]:5.1f} of {STEPS}")
    unseen = Hover(fit.vehicle, drawn[20:])
    print(f"vehicles not flown in learning: {np.mean([flown(unseen, policy, 10**6 + e) for e in range(50)]):.1f}")


if __name__ == "__main__":
    main()
