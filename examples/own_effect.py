"""Tries an effect of one's own that the catalogue lacks, without touching the simulation kernel.

    python examples/own_effect.py

Whatever acts between command and rotor is a function of the rotor speeds, so it can be put in front of the simulation:
here a supply so weak that above a knee the rotors follow only a share of the command.  Knee and share are fitted around
the usual fit, and judged, as always, on a flight that was not fitted.  An effect that earns its keep there is worth
adding to the kernel: CONTRIBUTING.md lists what that takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from quadid.data.grid import to_windows
from quadid.data.window import Window
from quadid.flight import TruthParameters, fly
from quadid.identification.fit import FitOptions, fit
from quadid.identification.result import mse_score
from quadid.vehicle import GRAVITY, Vehicle

TRUE = {"knee": 1.02, "share": 0.5}
"""The knee in hover speeds, which the flown vehicle knows and the fit does not."""
LOCAL = FitOptions(iterations=0)
"""From the initial guess to the nearest optimum, without the global search: the guess is good here."""


def weak_supply(windows: Sequence[Window], knee: float, share: float) -> list[Window]:
    """The effect: above `knee` [rad/s] the rotors follow only `share` of what is commanded beyond it."""
    return [
        replace(w, rotor_speed=np.minimum(w.rotor_speed, knee) + share * np.maximum(w.rotor_speed - knee, 0.0))
        for w in windows
    ]


def main() -> None:
    """Flies a vehicle with the effect, fits it, and says what it gains on an unseen flight."""
    pelican = Vehicle.shipped("pelican")
    seen, unseen = (
        to_windows(fly(pelican, seconds=25.0, seed=seed, outside={"weak_supply": TRUE}).recording, pelican)
        for seed in (1, 2)
    )
    plain = fit(seen, pelican)
    # The search starts from where the plain fit ended.
    guess = {n: p.model_copy(update={"initial": plain.parameters[n].value}) for n, p in pelican.parameters.items()}
    near = pelican.model_copy(update={"parameters": guess})
    hover = near.hover_speed()

    def cost(x: np.ndarray) -> float:
        inside = weak_supply(seen, float(x[0]) * hover, float(x[1]))
        return mse_score(inside, pelican, fit(inside, near, LOCAL).theta, plain.noise).mse

    best = minimize(cost, [1.0, 0.7], method="COBYQA", options={"maxfev": 13, "initial_tr_radius": 0.1})
    knee, share = float(best.x[0]) * hover, float(best.x[1])
    # Judged by the noise that the better model leaves; that of the plain fit holds some of what it lacks.
    better = fit(weak_supply(seen, knee, share), near, LOCAL)
    before = mse_score(unseen, pelican, plain.theta, better.noise).mse
    after = mse_score(weak_supply(unseen, knee, share), pelican, better.theta, better.noise).mse
    speed = TRUE["knee"] * true_hover_speed(pelican)
    print(f"knee {knee:.1f} rad/s (true {speed:.1f}), share {share:.2f} (true {TRUE['share']})")
    print(f"error on the unseen flight: {before:.2f} without, {after:.2f} with the effect")


def true_hover_speed(vehicle: Vehicle) -> float:
    """Hover speed [rad/s] of the vehicle that was flown, from its true thrust coefficient."""
    b = TruthParameters.of(vehicle).as_dict()["b"]
    return float(np.sqrt(vehicle.mass * GRAVITY / (len(vehicle.rotors) * b)))


if __name__ == "__main__":
    main()
