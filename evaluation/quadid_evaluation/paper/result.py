"""The numbers of `quadid reproduce` as JSON."""

from __future__ import annotations

import datetime

from quadid.chi_square import Z95
from quadid.parameters import NOMINAL_NAMES
from quadid.types import JsonDict
from quadid.version import __version__
from quadid_evaluation.paper.protocol import EFFECTS, STABILISER_RATE, Plan, Reproduced

SPENT = ("quasi_newton", "pso", "pso_polish")
"""Searches on the paper's objective, whose effort is told."""


def summary(done: Reproduced, plan: Plan, seed: int, seconds: float, command: str) -> JsonDict:
    """All numbers as JSON, of the form ``quadid.reproduce/1``.

    Args:
        done: what `quadid_evaluation.paper.protocol.reproduce` returned.
        plan: how much was done.
        seed: of flights and searches.
        seconds: that it took.
        command: that renews it.
    """

    return {
        "schema": "quadid.reproduce/1",
        "date": datetime.date.today().isoformat(),
        "version": __version__,
        "command": command,
        "seed": seed,
        "seconds": seconds,
        "flight": {
            "seconds": plan.seconds, "stabiliser_rate": STABILISER_RATE, "effects": EFFECTS,
            "truth": dict(done.protocol.truth), "logs": done.protocol.logs,
        },
        "swarm": {"particles": plan.particles, "iterations": plan.iterations, "seeds": plan.seeds},
        "mse_paper": {name: [s.mse for s in scores] for name, scores in done.paper.items()},
        "fit_percent": {name: [s.fit_percent for s in scores] for name, scores in done.paper.items()},
        "mse": done.mse,
        "noise_floor": 1.0,
        "orders": done.orders,
        "parameters": _parameters(done),
        "correlations": done.fit.parameters.correlation,
        "verdict": done.diagnosis.verdict.value.replace("_", " "),
        "findings": [finding.to_dict() for finding in done.diagnosis.findings],
        "effort": {
            name: {"evaluations": done.columns[name].evaluations, "seconds": done.columns[name].seconds}
            for name in SPENT
        },
    }  # fmt: skip


def _parameters(done: Reproduced) -> JsonDict:
    """Table 2: every estimate of every parameter, with intervals where there are any."""

    out = {}
    for i, name in enumerate(NOMINAL_NAMES):
        p, extended, sigma = done.fit.parameters[name], done.columns["extended"].theta[i], done.sigma[name]
        out[name] = {
            "truth": done.protocol.truth[name],
            **{c: float(done.columns[c].theta[i]) for c in ("initial", *SPENT, "identified", "extended")},
            "pso_seeds": [float(theta[i]) for theta in done.columns["pso"].others],
            "ci95": list(p.ci95),
            "status": p.status.value.replace("_", " ") + (f" to {p.relative_to}" if p.relative_to else ""),
            "extended_ci95": [float(extended - Z95 * sigma), float(extended + Z95 * sigma)],
        }
    return out
