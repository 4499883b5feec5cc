"""The page of a diagnosis, and the part that other pages take from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from quadid.identify.noise import NoiseModel
from quadid.identify.result import ScoredSet
from quadid.report.advice import ADVICE
from quadid.report.figures import MODELS, MOST_LOGS, channel_figures, error_figure, gain_figure
from quadid.report.identify_page import noise_rows
from quadid.report.verdict import Level, Verdict

JsonDict = Mapping[str, Any]

_LEVELS: dict[str, Level] = {
    "nothing_found": "good",
    "explained": "good",
    "partly_explained": "fair",
    "unknown": "poor",
}
_SENTENCES = {
    "nothing_found": "The simulation agrees with the flight: nothing was found that it gets wrong.",
    "explained": "What the simulation gets wrong is explained by what is named here.",
    "partly_explained": "What is named here explains most of what the simulation gets wrong; some remains.",
    "unknown": "The simulation gets something wrong that no known cause explains.",
}


def diagnose_verdict(result: JsonDict) -> Verdict:
    """Judges a result of the form ``quadid.diagnose/1``."""
    named = [f["effect"].replace("_", " ") for f in result["findings"] if f["confident"]]
    verdict = result["verdict"]
    headline = _SENTENCES[verdict]
    if named and verdict != "unknown":
        headline = f"Found: {', '.join(named)}. {headline}"
    v = result["validation"]
    details = (
        f"Error on data the fit did not see, in noise variances (1 is the noise floor): {_short(v['mse_nominal'])} "
        f"without and {_short(v['mse_extended'])} with what was found.",
    )
    return Verdict(_LEVELS[verdict], headline, details, _next_steps(result))


def _short(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def _next_steps(result: JsonDict) -> tuple[str, ...]:
    named = [f["effect"] for f in result["findings"] if f["confident"] and f["effect"] in ADVICE][:3]
    out = [
        f"{effect.replace('_', ' ').capitalize()}: {ADVICE[effect][0].lower()}{ADVICE[effect][1:]}" for effect in named
    ]
    if result["verdict"] in ("partly_explained", "unknown"):
        where = ", ".join(result["unexplained"]) or "no single channel"
        out.append(f"What remains unexplained sits in: {where}. A flight that excites it more may tell it apart.")
    if result["findings"]:
        out.append("The extended vehicle file works with every other command, for example `quadid score`.")
    else:
        out.append("Nothing to change. A livelier flight shows more: `quadid excite`.")
    return tuple(out)


def diagnosis_part(
    result: JsonDict, sets: Sequence[ScoredSet] = (), prefix: str = "d", title: str = "", intro: str = ""
) -> dict[str, Any]:
    """A diagnosis as part of a page: verdict, findings, pictures.

    Args:
        result: of the form ``quadid.diagnose/1``.
        sets: logs scored without (`initial`) and with (`fitted`) the findings.
        prefix: makes identifiers of figures unique on the page.
        title: heading, where a page holds several.
        intro: sentence below it.
    """
    floor = result["validation"]["noise_floor"]
    findings = [
        {
            **finding,
            "title": finding["effect"].replace("_", " "),
            "advice": ADVICE.get(finding["effect"], ""),
            "figures": [gain_figure(finding, floor, f"{prefix}-gain{i}")],
        }
        for i, finding in enumerate(result["findings"])
    ]
    pictured = list(sets)[:MOST_LOGS] if findings else []
    logs = [
        {
            "log": s.log,
            "role": s.role,
            "figures": [
                error_figure(s, f"{prefix}-log{i}-error", MODELS),
                *channel_figures(s, f"{prefix}-log{i}", len(pictured) + 2, MODELS),
            ],
        }
        for i, s in enumerate(pictured)
    ]
    return {
        "title": title,
        "intro": intro,
        "verdict": asdict(diagnose_verdict(result)),
        "findings": findings,
        "unexplained": result["unexplained"],
        "logs": logs,
    }


def diagnose_page(
    result: JsonDict, vehicle: str, sets: Sequence[ScoredSet], noise: NoiseModel, quality: Sequence[JsonDict],
    provenance: Sequence[JsonDict], warnings: Sequence[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Builds the page of a diagnosis; arguments as in `diagnosis_part` and `identify_page`."""
    part = diagnosis_part(result, sets)
    fitted, held = (sum(s.role == role for s in sets) for role in ("train", "validate"))
    return {
        "title": f"Diagnosis of {vehicle}",
        "subtitle": f"{fitted} log{'s' * (fitted != 1)} diagnosed, {held or 'none'} held out for validation",
        "verdict": part["verdict"],
        "diagnoses": [{**part, "verdict": None}],
        "warnings": list(warnings),
        "quality": quality,
        "noise": noise_rows(noise),
        "provenance": provenance,
    }
