"""The searches that an identification offers, behind one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING

from quadid.errors import ParameterError, nearest

if TYPE_CHECKING:
    from quadid.identify.fit import Fit
    from quadid.vehicle import Vehicle
    from quadid.window import Window
    from quadid_workflow.progress import Advance

OPTIMIZERS = (
    "pso_polish", "pso", "initial", "quasi_newton", "least_squares", "cma_es", "l_shade", "differential_evolution",
    "pso_algorithm_1",
)  # fmt: skip
BUDGET = 4000
"""Simulations of the data that any search but the standard one may spend."""


def check_optimizer(name: str) -> None:
    """Raises ParameterError for an unknown search, with the nearest known one."""
    if name not in OPTIMIZERS:
        raise ParameterError(f"unknown optimizer '{name}'", ", ".join(OPTIMIZERS), nearest(name, OPTIMIZERS))


def check_seed(seed: int) -> None:
    """Raises ParameterError for a seed that no generator takes."""
    if not isinstance(seed, Integral) or seed < 0:
        raise ParameterError(f"seed {seed}", "a whole number from 0 on")


def search(
    name: str, windows: Sequence[Window], vehicle: Vehicle, seed: int, advance: Advance,
    out_of_reach: Mapping[str, str] | None = None,
) -> Fit:  # fmt: skip
    """Identifies the parameters with the search called `name`.

    The sensor noise, which decides intervals and scores, always comes from the standard fit; with the other searches
    the parameters are where that search ended, not where the standard fit ends.  Parameters `out_of_reach` of the
    channels, with the reason, keep the file's value.
    """
    from quadid.identify.fit import FitOptions, fit, fit_at

    if name == "pso_polish":
        return fit(windows, vehicle, FitOptions(seed=seed), progress=advance, out_of_reach=out_of_reach)
    from quadid.identify.identifiability import final_answer
    from quadid.identify.shooting_objective import BoxProblem
    from quadid.optimisers.minimise import minimise

    standard = fit(windows, vehicle, FitOptions(seed=seed), progress=lambda stage, share: advance("noise", share))
    advance(name, 0.0)
    problem = BoxProblem(windows, vehicle)
    found = minimise(name, problem.cost, problem.start, problem.lower, problem.upper, BUDGET, seed, problem.residual)
    at = fit_at(windows, vehicle, problem.theta(found.x), standard.noise, found.evaluations, str(found.stop))
    return final_answer(at, out_of_reach or {})
