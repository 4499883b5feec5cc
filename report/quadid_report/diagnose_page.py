"""The page of a diagnosis, and the part that other pages take from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from quadid.effects import EFFECTS
from quadid.identify.noise_model import NoiseModel
from quadid.identify.result import ScoredSet
from quadid.identify.score import SCORE_SECONDS
from quadid.types import Json
from quadid_report.figures import MODELS, MOST_LOGS, channel_figures, error_figure, gain_figure
from quadid_report.identify_page import noise_table, parameter_row
from quadid_report.page import number, unit
from quadid_report.parts import measures
from quadid_report.residual_maps import ResidualMap, map_figure
from quadid_report.verdict import NOISE_LEVEL, Level, Verdict, percent

HELD_OUT = "held-out blocks"
"""What a diagnosis without validation logs measures its gain on."""
_LEVELS: dict[str, Level] = {
    "nothing_found": "good",
    "explained": "good",
    "partly_explained": "fair",
    "unknown": "poor",
}


def diagnose_verdict(result: Json) -> Verdict:
    """Judges a result of the form ``quadid.diagnose/1``."""
    large, small = _named(result)
    verdict = result["verdict"]
    headline = result["statement"]
    if (large or small) and verdict != "unknown":
        found = [", ".join(large)] if large else []
        found += [f"no larger than on most vehicles: {', '.join(small)}"] if small else []
        headline = f"Found: {'; '.join(found)}. {headline}"
    v = result["validation"]
    held_out = v.get("on") == HELD_OUT
    where = "held-out blocks of the same flight" if held_out else "unseen flights"
    change = _change(v, bool(result["findings"]))
    details: tuple[str, ...] = (f"The error on {where} {change} noise variances (1 is the noise floor).",)
    deciding = v.get("deciding")
    if result["findings"] and deciding and deciding["seconds"] != SCORE_SECONDS:
        details = (
            *details,
            f"In simulations of {deciding['seconds']:g} s, on which the causes were chosen, "
            f"it {_change(deciding, True)}.",
        )
    level, left = _LEVELS[verdict], v.get("mse_extended_refitted") or v["mse_extended"]
    steps = _next_steps(result)
    if level == "good" and (held_out or left is None or left > NOISE_LEVEL):
        level = "fair"
    if held_out:
        details = (*details, "Not validated: no unseen flight was given.")
        steps = ("To validate it, add another flight with --validate.", *steps)
    return Verdict(level, headline, details, steps)


def _change(errors: Json, found: bool) -> str:
    """What findings make of the error."""
    before, after = errors["mse_nominal"], errors["mse_extended"]
    if not found:
        return f"is {_short(before)}"
    rises = before is not None and after is not None and after > before
    return f"{'rises' if rises else 'falls'} from {_short(before)} to {_short(after)}"


def chance(p_value: float) -> str:
    """A p-value that claims no more than its distribution holds: below a billionth only that it is."""
    return f"p = {number(p_value, 2)}" if p_value >= 1e-9 else "p < 1e-9"


def _short(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def _named(result: Json) -> tuple[list[str], list[str]]:
    """Confident findings by name: those to do something about, and those no larger than on most vehicles."""
    sure = [f for f in result["findings"] if f["confident"]]
    large = [f["effect"].replace("_", " ") for f in sure if not f.get("ordinary")]
    small = [f["effect"].replace("_", " ") for f in sure if f.get("ordinary")]
    return large, small


def _next_steps(result: Json) -> tuple[str, ...]:
    sure = [f for f in result["findings"] if f["confident"] and not f.get("ordinary")]
    named = [f["effect"] for f in sure if f["effect"] in EFFECTS][:3]
    out = [
        f"{effect.replace('_', ' ').capitalize()}: {advice[0].lower()}{advice[1:]}"
        for effect, advice in ((e, EFFECTS[e].advice) for e in named)
    ]
    if result["verdict"] in ("partly_explained", "unknown"):
        where = f"is in {', '.join(result['unexplained'])}" if result["unexplained"] else "is spread over all channels"
        out.append(f"The unexplained error {where}: a livelier flight (`quadid excite`) may show its cause.")
    if result["findings"]:
        out.append("The extended vehicle file works with every other command, for example `quadid score`.")
    else:
        out.append("Nothing to change. A livelier flight shows more: `quadid excite`.")
    return tuple(out)


def diagnosis_part(
    result: Json, sets: Sequence[ScoredSet] = (), prefix: str = "d", title: str = "", intro: str = "",
    maps: Mapping[str, ResidualMap] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """A diagnosis as part of a page: verdict, findings, pictures.

    Args:
        result: of the form ``quadid.diagnose/1``.
        sets: logs scored without (`initial`) and with (`fitted`) the findings.
        prefix: makes identifiers of figures unique on the page.
        title: heading, where a page holds several.
        intro: sentence below it.
        maps: what each cause looks like in the residual, by name of the effect.
    """
    findings = [
        finding_part(finding, result["validation"]["noise_floor"], f"{prefix}-{i}", (maps or {}).get(finding["effect"]))
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
        "remains": remaining(result, sets),
        "logs": logs,
    }


_REMARKS = {
    "per_log": "It belongs to this flight, not to the vehicle: another flight has its own.",
    "ordinary": "It is no larger than on most vehicles and is therefore listed after larger causes.",
}


def _advice(finding: Json) -> str:
    """What to do about a cause, and what sets it apart."""
    known = EFFECTS.get(finding["effect"])
    parts = [] if known is None or finding.get("ordinary") else [known.advice]
    return " ".join([*parts, *(text for key, text in _REMARKS.items() if finding.get(key))]).strip()


def finding_part(finding: Json, floor: float, identifier: str, seen: ResidualMap | None) -> dict[str, Any]:
    """One cause: its picture, its gain with interval, the rejected alternatives.

    Args:
        finding: of the form ``quadid.diagnose/1``.
        floor: noise floor in the measure of the gains.
        identifier: makes identifiers of figures unique.
        seen: the cause in the residual, where the flight shows it.
    """
    name, gain = finding["effect"].replace("_", " "), finding["gain"]
    low, high = gain.get("ci95", (None, None))
    gained = [
        f"The error of {gain['seconds']:g} s runs on unseen data falls by "
        f"{_short(_less(gain['mse_before'], gain['mse_after']))} noise variances"
    ]
    if low is not None and high is not None:
        gained.append(f" (95 % interval {low:.3g} to {high:.3g})")
    if finding["p_value"] is not None:
        gained.append(f"; {chance(finding['p_value'])}")
    rivals = [f"{a['effect'].replace('_', ' ')} ({_short(a['mse_after'])})" for a in finding["alternatives"]]
    return {
        **finding,
        "title": name,
        "advice": _advice(finding),
        "gained": "".join(gained) + ".",
        "noise": _noise_sentence(gain, floor, name),
        "rivals": f"Rejected alternatives, with the error they leave: {', '.join(rivals)}."
        if rivals else "No other cause of the catalogue came near it.",
        "figures": [
            *([map_figure(seen, f"{identifier}-map", name)] if seen is not None else []),
            gain_figure(finding, floor, f"{identifier}-gain"),
        ],
    }  # fmt: skip


def _less(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else before - after


def _noise_sentence(gain: Json, floor: float, name: str) -> str:
    """How much of the error is sensor noise that no model removes, without and with the cause."""
    shares = [min(floor / v, 1.0) if v else None for v in (gain["mse_before"], gain["mse_after"])]
    if None in shares:
        return ""
    without, having = (percent(s) for s in shares if s is not None)
    return (
        f"Share of the error that is sensor noise, which no model can remove: {without} without {name}, {having} with."
    )


def remaining(result: Json, sets: Sequence[ScoredSet]) -> dict[str, Any]:
    """What is left: by channel, and what it follows."""
    channels = {c.name: c for s in sets[-1:] for c in s.fitted.channels}
    rows = [
        (name, percent(share), number(known.rmse if known else None, 3), unit(known.unit if known else ""))
        for name, share in sorted(result["unexplained"].items(), key=lambda item: -item[1])
        for known in [channels.get(name)]
    ]
    follows = [
        f"the {f['acts_on']} follows {f['signal'].rstrip(',')} ({percent(f['share'])} of the noise)"
        for f in result.get("unexplained_follows", ())
    ]
    head = ("Channel", "Share of its error beyond noise", "Root mean squared error", "Unit")
    return {"table": measures(head, rows, (1, 2)), "follows": follows}


def diagnose_page(
    result: Json, vehicle: str, sets: Sequence[ScoredSet], noise: NoiseModel, quality: Sequence[Json],
    provenance: Sequence[Json], warnings: Sequence[str] = (), maps: Mapping[str, ResidualMap] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Builds the page of a diagnosis; arguments as in `diagnosis_part` and `identify_page`."""
    part = diagnosis_part(result, sets, maps=maps)
    fitted, held = (sum(s.role == role for s in sets) for role in ("train", "validate"))
    return {
        "title": f"Diagnosis of {vehicle}",
        "subtitle": f"{fitted} log{'s' * (fitted != 1)} diagnosed, {held or 'none'} held out for validation",
        "verdict": part["verdict"],
        "parameters": [parameter_row(p) for p in result.get("parameters", ())],
        "diagnoses": [{**part, "verdict": None}],
        "warnings": list(warnings),
        "quality": quality,
        "noise": noise_table(noise),
        "provenance": provenance,
    }
