"""Promises of proposed manoeuvres.  Predicted intervals against those obtained, and against the pilot's.

    python -m quadid_evaluation.studies.excite --out docs/results

Each seed is a new individual Pelican with a poor guess.  Its pilot flies gently for a minute; `quadid excite` looks at
that log and proposes a minute; the true vehicle flies it, and as a yardstick the pilot flies another gentle minute, and
one in which he moves all sticks.  Both minutes together are identified each time.  Then the manoeuvre is flown once
more: that minute by itself is forecast with what the first two told, and identified.
"""

import math

import numpy as np

from quadid.app.excite import knowledge
from quadid.data.window import Window
from quadid.experiment import Limits, Proposal, TrialFlights, design_manoeuvre, peaks
from quadid.flight import Flight, draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.identification.result import fitted_vehicle
from quadid.identification.uncertainty import halfwidths
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import study, table
from quadid_evaluation.studies.truth import poor_guess

LIMITS = Limits(math.radians(25.0), math.radians(150.0))
CRAFT = Vehicle.shipped("pelican")


def quiet(stage: str, share: float) -> None:
    """Takes no notice of progress."""


def obtained(windows: list[Window], vehicle: Vehicle, seed: int) -> FloatArray:
    """Relative 95 % half-widths (6,) after identifying `windows`."""
    found = fit(windows, vehicle, FitOptions(iterations=0, seed=seed))
    return halfwidths(np.linalg.inv(found.uncertainty.covariance))


def run(seed: int, seconds: float) -> tuple[FloatArray, FloatArray, bool]:
    """One seed: half-widths (8, 6) after one gentle flight, two, a lively one, predicted, predicted anew, obtained, and
    of the manoeuvre flown again, predicted and obtained; errors (6,) in standard deviations; whether the true vehicle
    stayed within the limits, a tenth allowed."""
    truth = draw_truth(CRAFT, seed)
    vehicle = poor_guess(CRAFT, truth.as_dict(), seed)
    first = fly(CRAFT, truth, seconds, seed, "gentle").window
    believed, known, before = knowledge(vehicle, [first], seed, quiet)
    noise = None if before is None else before.noise
    proposal = design_manoeuvre(TrialFlights(believed, noise, seed), known, LIMITS, seconds, quiet)
    length = proposal.seconds
    flown = fly(CRAFT, truth, length, seed + 1, "scripted", segments=proposal.segments)
    widths = [proposal.now]
    for profile in ("gentle", "excited"):
        widths.append(obtained([first, fly(CRAFT, truth, length, seed + 1, profile).window], vehicle, seed))
    found = fit([first, flown.window], vehicle, FitOptions(iterations=0, seed=seed))
    # The same manoeuvre weighed again with what it told: differs from the forecast where the guess was poor.
    wiser = TrialFlights(fitted_vehicle(found), found.noise, seed)
    again = wiser.information(wiser.fly(proposal.segments, length))
    widths += [proposal.after, halfwidths(known + again), obtained([first, flown.window], vehicle, seed)]
    second = fly(CRAFT, truth, length, seed + 2, "scripted", segments=proposal.segments).window
    widths += [halfwidths(again), obtained([second], vehicle, seed)]
    exact = np.log([truth.as_dict()[n] for n in NOMINAL_NAMES])
    errors = np.asarray((np.log(found.theta[:6]) - exact) / found.uncertainty.sigma)
    return np.array(widths), errors, held(flown, proposal)


def held(flown: Flight, proposal: Proposal) -> bool:
    """Checks whether the true vehicle stayed within a tenth of the limits that its simulation kept."""

    peak = peaks(flown)
    return peak.tilt < 1.1 * LIMITS.tilt and peak.rate < 1.1 * LIMITS.rate


def sentences(widths: FloatArray, inside: float, kept: int) -> list[str]:
    """Sentences on the figures; half-widths (seeds, 8, 6) as of `run`."""
    out = []
    for k, got, name in (
        (3, 5, "the forecast, made with the values believed before"),
        (4, 5, "the same weighed anew"),
        (6, 7, "the forecast of the manoeuvre flown again, made with what the minutes before it told"),
    ):
        ratio = widths[:, got] / widths[:, k]
        out.append(
            f"* Obtained intervals are within 20 % of {name}, in {np.mean(np.abs(ratio - 1.0) < 0.2):.0%} of all cases "
            f"({ratio.min():.2f} to {ratio.max():.2f})."
        )
    worst = np.argmax(widths[:, 1], axis=1)
    gains = np.array([w[1, j] / w[5, j] for w, j in zip(widths, worst, strict=True)])
    known = np.array([w[1] / w[5] for w in widths])[:, 2:4]
    out.append(
        f"* The worst interval of two gentle minutes becomes {gains.min():.0f} to {gains.max():.0f} times narrower; "
        f"those of J_xx and J_yy, which gentle flight does tell, {known.min():.0f} to {known.max():.0f} times."
    )
    out.append(f"* {inside:.0%} of all errors lie within the 95 % interval.")
    out.append(f"* {kept} of {len(widths)} vehicles stayed within the limits, a tenth allowed.")
    return out


REMARK = """\
* Where the forecast is off: a relative interval depends on the parameter's own value, and after a gentle minute d, J_zz
  and J_r are not known at all. With the values that the manoeuvre taught the same calculation agrees."""


def page(seeds: int, seconds: float) -> str:
    """The page of so many vehicles."""
    results = [run(30_000 + seed, seconds) for seed in range(seeds)]
    widths = 100.0 * np.array([r[0] for r in results])
    inside = np.mean(np.abs([r[1] for r in results]) < 1.96)
    middle = np.median(widths, axis=0)
    heads = (
        "parameter",
        "one gentle minute",
        "two",
        "gentle, then lively",
        "manoeuvre, forecast",
        "obtained",
        "times narrower than two gentle",
    )
    rows = [
        (name, *(f"{middle[k, j]:.3g}" for k in (0, 1, 2, 3, 5)), f"{np.median(widths[:, 1, j] / widths[:, 5, j]):.1f}")
        for j, name in enumerate(NOMINAL_NAMES)
    ]
    return "\n".join(
        [
            "`make excite`",
            "",
            (__doc__ or "").split("\n\n")[2].replace("  ", " "),
            "",
            f"Relative 95 % half-width in per cent, median of {seeds} vehicles:",
            "",
            *table(heads, rows),
            "",
            *sentences(widths, float(inside), sum(r[2] for r in results)),
            REMARK,
        ]
    )


if __name__ == "__main__":
    study(
        __doc__,
        "excite.md",
        "What to fly next",
        {"measured": lambda g: page(g.seeds, g.seconds)},
        seeds=10,
        seconds=60.0,
    )
