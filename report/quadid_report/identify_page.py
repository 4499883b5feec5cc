"""The page of an identification: its dictionary, the scored logs and where all came from, as `render` wants them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from quadid.identify.noise_model import NoiseModel
from quadid.identify.result import ScoredSet
from quadid.model.channels import CHANNEL_NAMES, CHANNEL_UNITS
from quadid.parameters import ParameterSet
from quadid.types import Json, JsonDict
from quadid_report.figures import MOST_LOGS, channel_figures, error_figure, parameter_figure
from quadid_report.page import fit, number, unit
from quadid_report.parts import measures, rows_of, section
from quadid_report.verdict import at_bounds, identify_verdict, percent, reason, relative_halfwidth
from quadid_report.words import parameter_name, status_words

FIT_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_z")


def identify_page(
    result: Json, sets: Sequence[ScoredSet], noise: NoiseModel, quality: Sequence[Json],
    provenance: Sequence[Json], truth: Mapping[str, float] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Builds the page of an identification.

    Args:
        result: of the form ``quadid.identify/1``.
        sets: the scored logs in the order of ``result["sets"]``.
        noise: estimated sensor noise.
        quality: per log: name, format, summary (sentences), channels (name, rate [Hz], samples, source, faults).
        provenance: rows of name and value.
        truth: true parameters, where a simulation knows them.
    """
    return {
        "title": f"Identification of {result['vehicle']}",
        "subtitle": _subtitle(result),
        "verdict": asdict(identify_verdict(result)),
        "parameters": [parameter_row(p, truth, at_bounds(result)) for p in result["parameters"]],
        "parameter_figure": parameter_figure(result["parameters"], truth),
        "fit": fit_table(result["sets"]),
        "sets": set_sections(result["sets"], sets),
        "warnings": result["warnings"],
        "quality": quality,
        "noise": noise_table(noise),
        "provenance": provenance,
    }


def _subtitle(result: Json) -> str:
    roles = [s["role"] for s in result["sets"]]
    fitted, held = roles.count("train"), roles.count("validate")
    text = f"{fitted} log{'s' * (fitted != 1)} fitted, {held or 'none'} held out for validation"
    return f"{text}; search {result['optimizer']}, {result['seconds']:.1f} s"


def parameter_row(
    parameter: Json, truth: Mapping[str, float] | None = None, stuck: Sequence[str] = ()
) -> dict[str, Any]:
    """A parameter with its margin, its reason, and the truth where known."""
    row = {
        "relative_to": None,
        **parameter,
        "title": parameter_name(parameter["name"]),
        "status_words": status_words(parameter),
        "margin": percent(relative_halfwidth(parameter)).replace(" ", "\u00a0"),
        "reason": reason(parameter, stuck).replace(" %", "\u00a0%"),
    }
    if truth:
        row["truth"] = truth.get(parameter["name"])
    return row


def set_sections(entries: Sequence[Json], sets: Sequence[ScoredSet]) -> list[dict[str, Any]]:
    """The logs of a result with their figures; the first few logs only get figures."""
    out, shown = [], min(len(sets), MOST_LOGS)
    for i, (entry, scored) in enumerate(zip(entries, sets, strict=True)):
        figures = (
            [error_figure(scored, f"log{i}-error"), *channel_figures(scored, f"log{i}", shown)] if i < MOST_LOGS else []
        )
        rows = [
            (n, number(e["value"], 3), unit(e["unit"]), fit(entry["fit_percent"].get(n)))
            for n, e in entry["rmse"].items()
        ]
        channels = measures(("Channel", "Root mean squared error", "Unit", "Fit"), rows, (1, 3))
        out.append({**entry, "figures": figures, "channels": channels})
    return out


def fit_table(entries: Sequence[Json]) -> JsonDict:
    """Errors of every log before and after, and how well channels fit."""
    names = [n for n in FIT_NAMES if any(n in s["fit_percent"] for s in entries)]
    head = ("Log", "Used for", "Error before", "Error after", *(f"Fit {n}" for n in names))
    rows = [
        (
            s["log"], "fitting" if s["role"] == "train" else "validation", number(s["mse"]["initial"], 3),
            number(s["mse"]["fitted"], 3), *(fit(s["fit_percent"].get(n)) for n in names),
        )
        for s in entries
    ]  # fmt: skip
    return rows_of(head, rows, classes=("", "", "number", "number strong", *["number"] * len(names)))


def noise_table(noise: NoiseModel) -> JsonDict:
    """Standard deviations of the white and the slow part of every channel."""
    each = zip(CHANNEL_NAMES, noise.white, noise.slow, CHANNEL_UNITS, strict=False)
    rows = [(name, number(float(white), 3), number(float(slow), 3), unit(of)) for name, white, slow, of in each]
    return measures(("Channel", "White", "Slow", "Unit"), rows, (1, 2))


def correlation_section(parameters: ParameterSet) -> dict[str, Any]:
    """Correlations of the parameters: near 1 or -1, the flight hardly separates two of them."""
    correlation, names = parameters.correlation, list(parameters.names)
    rows = [
        [name, *(f"{correlation[i, j]:+.2f}" if i != j else "1" for j in range(len(names)))]
        for i, name in enumerate(names)
    ]
    intro = "Near +1 or -1 the flight hardly separates two parameters: fly what moves one of them alone."
    return section("correlations", "Correlations", intro, tables=[rows_of(["", *names], rows)])
