"""Verdicts in plain words: a headline, one sentence a parameter, what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from quadid.effects import EFFECTS
from quadid.types import Json

# --- Names of parameters and statuses as people read them


PARAMETER_NAMES: dict[str, str] = {
    "b": "Thrust coefficient",
    "d": "Drag coefficient",
    "J_xx": "Roll inertia",
    "J_yy": "Pitch inertia",
    "J_zz": "Yaw inertia",
    "J_r": "Rotor inertia",
    "b_tangent": "Slope of thrust",
}
STATUS_WORDS: dict[str, str] = {
    "identified": "identified",
    "ratio_only": "only its ratio to {}",
    "prior_dominated": "not observable",
    "unreliable": "unreliable",
}


def parameter_name(symbol: str) -> str:
    """``Thrust coefficient b`` for ``b``; names of effects as they are."""
    return f"{PARAMETER_NAMES[symbol]} {symbol}" if symbol in PARAMETER_NAMES else symbol


def status_words(parameter: Mapping[str, Any]) -> str:
    """A parameter's status for people; `parameter` as in ``quadid.identify/1``."""
    if decided_before(parameter):
        return f"{100.0 * parameter['prior_share']:.0f} % from the file"
    return STATUS_WORDS[parameter["status"]].format(parameter.get("relative_to", "another"))


def decided_before(parameter: Mapping[str, Any]) -> bool:
    """True if earlier knowledge, such as a `sigma` of the vehicle file, decides the value rather than this flight."""
    return parameter["status"] == "prior_dominated" and bool(parameter.get("measured_before"))


def effects_words(effects: Mapping[str, Mapping[str, float]]) -> str:
    """Effects of a vehicle file with their values: ``motor lag (tau = 0.03 s)``."""
    parts = []
    for effect, values in effects.items():
        told = ", ".join(f"{k} = {v:g} {EFFECTS[effect].parameter(k).unit}" for k, v in values.items())
        parts.append(f"{effect.replace('_', ' ')} ({told})")
    return ", ".join(parts)


# --- What a result means, in plain words: a headline, one sentence a parameter, and what to do next


Level = Literal["good", "fair", "poor"]

NOISE_LEVEL = 1.3
"""Up to this mean square, in units of what a model expects, it is right about its own errors."""
ROUGH = 5.0
"""Above it a model is wrong about its own errors: its values and its intervals are not to be used."""
SMALL_FORCE, SMALL_MOMENT = 0.01, 0.05
"""Missing force as a share of the weight, and moment as a share of the rotors', that do not count."""
NEAR_FLOOR = 2.0
"""Up to this multiple of the floor a prediction error may be sensor noise: the floor is that of white noise alone."""
LEAST_SECONDS = 10.0
"""Flight that it takes to prove anything [s]: ten runs of one second."""
_TOGETHER = (
    "To let the flights decide, fit them together, `quadid identify FLIGHT FLIGHT …`, from a file without sigma."
)
_DIAGNOSE = "`quadid diagnose` names missing effects and measures what the extended model gains."
MOTION = {
    "b": "climbs and descents",
    "d": "yaw turns",
    "J_xx": "quick roll doublets",
    "J_yy": "quick pitch doublets",
    "J_zz": "quick yaw doublets, together with roll and pitch",
    "J_r": "roll and pitch doublets while yawing",
}
"""Motion that the vehicle must make for each parameter to show."""


@dataclass(frozen=True)
class Verdict:
    """A judgement.

    Attributes:
        level: good, fair or poor.
        next_steps: what to do, most useful first.
    """

    level: Level
    headline: str
    details: tuple[str, ...]
    next_steps: tuple[str, ...]

    def lines(self) -> list[str]:
        """Headline, details and next steps, a line each."""
        return [self.headline, *self.details, *(f"Next: {step}" for step in self.next_steps)]


def identify_verdict(result: Json) -> Verdict:
    """Judges the result of ``quadid identify``.

    Green needs all parameters identified, nothing missing that counts, and `LEAST_SECONDS` of flight that was not
    fitted; red is a model that is wrong about its own errors.

    Args:
        result: a dictionary of the form ``quadid.identify/1``.
    """
    parameters, sets = result["parameters"], result["sets"]
    stuck = at_bounds(result)
    known = [p for p in parameters if p["status"] == "identified" and p["name"] not in stuck]
    before = [p["name"] for p in parameters if decided_before(p)]
    open_ones = [p for p in parameters if p["status"] != "identified" and p["name"] not in before]
    judged = judging(sets)
    ratio = worst(sets)
    where = "the validation flight" if judged[0]["role"] == "validate" else "the fitted flight"
    level, match = _match(ratio, _missing_shares(result), where)
    lacking, adequate = _lacking(sets), level == "good"
    if not known and not before:
        level = "poor"
    elif (before or open_ones or stuck or lacking) and level == "good":
        level = "fair"
    headline = f"{_count(len(known), len(parameters))} identified; {match}."
    if before and not known and len(before) == len(parameters):
        headline = f"All {len(before)} parameters known from earlier flights; {match}."
    rest = f"Determined by the sigmas of the vehicle file, not by this flight: {', '.join(before)}."
    missing = (result.get("missing") or {}).get("statement")
    details = (*([rest] if before else []), *lacking, *([missing] if missing else []), *_details(known, judged))
    if not ratio <= ROUGH:
        headline = f"Not to be used yet: {match}."
        found = (
            "Something that the model lacks differs between this flight and the fitted ones; values can be wrong even "
            "where the interval is narrow."
        )
        details = (found, *([missing] if missing else []), *_details((), judged))
    steps = _next_steps(result, open_ones, stuck, ratio, adequate)
    return Verdict(level, headline, details, (_TOGETHER, *steps) if before and ratio <= ROUGH else steps)


def judging(sets: Sequence[Json]) -> list[Json]:
    """The logs that judge a result: those that were not fitted, else all."""
    return [s for s in sets if s["role"] == "validate"] or list(sets)


def worst(sets: Sequence[Json]) -> float:
    """Largest mean square of whitened innovations of the judging logs."""
    return max(_number(s["mse"]["fitted"]) for s in judging(sets))


def _lacking(sets: Sequence[Json]) -> tuple[str, ...]:
    """Reasons that keep a result from being proven."""
    unseen, seen = (
        [_number(s.get("seconds", LEAST_SECONDS)) for s in sets if s["role"] == role] for role in ("validate", "train")
    )
    if not unseen:
        return ("Not validated: no unseen flight was given.",)
    out = []
    for which, seconds in (("fitted", sum(seen)), ("unseen", sum(unseen))):
        if seconds < LEAST_SECONDS:
            out.append(f"Not validated: only {seconds:.1f} s of {which} flight, {LEAST_SECONDS:g} s are needed.")
    return tuple(out)


def score_verdict(result: Json) -> Verdict:
    """Judges the result of ``quadid score`` by its longest horizon.

    Args:
        result: a dictionary of the form ``quadid.score/1`` with ``noise_floor`` and ``no_change``.
    """
    last = list(result["horizons"])[-1]
    errors, floor, still = result["horizons"][last], result["noise_floor"][last], result["no_change"][last]
    known = [n for n, v in errors.items() if math.isfinite(_number(v)) and _number(still.get(n)) > 0.0]
    runaway = any(_number(v) == math.inf for v in errors.values())
    above = {n: _number(errors[n]) / _number(floor[n]) for n in known if _number(floor[n]) > 0.0}
    share = {n: _number(errors[n]) / _number(still[n]) for n in known}
    if runaway or not known or max(share.values()) >= 1.0:
        worse = [n for n in known if share[n] >= 1.0]
        what = f"worse than predicting no change: {', '.join(worse)}" if worse else "the simulation diverges"
        return Verdict("poor", f"Not to be used: after {last} samples {what}.", (), (_DIAGNOSE,))
    mean = ", ".join(f"{n} {percent(s)}" for n, s in share.items())
    detail = f"Error after {last} samples relative to predicting no change: {mean}."
    worst = max(above, key=lambda n: above[n], default=None)
    if worst is None or above[worst] <= NEAR_FLOOR:
        return Verdict("good", f"After {last} samples the errors are at the noise floor.", (detail,), ())
    headline = f"After {last} samples the {worst} error is {above[worst]:.3g} times the noise floor."
    return Verdict("fair", headline, (detail,), (_DIAGNOSE,))


def _missing_shares(result: Json) -> tuple[float, float] | None:
    """Largest missing force over the weight and moment over the rotors', of the logs that judge; None: not seen."""
    if not result.get("missing"):
        return None
    judged = judging(result["missing"]["sets"])
    forces = [math.hypot(*s["force"]["nominal"].values()) / s["force"]["of"] for s in judged]
    moments = [s["moment"]["nominal"][axis] / size for s in judged for axis, size in s["moment"]["of"].items() if size]
    return max(forces), max(moments, default=0.0)


def _match(ratio: float, shares: tuple[float, float] | None, where: str) -> tuple[Level, str]:
    """Level and words for the mean square of whitened innovations and what is missing."""
    if not math.isfinite(ratio):
        return "poor", f"the simulation diverges on {where}"
    if ratio > ROUGH:
        return "poor", f"on {where} errors are {math.sqrt(ratio):.2g} times what the model expects"
    if shares is None:
        return "fair", f"without gyro and accelerometer it is unknown what the simulation misses on {where}"
    if ratio <= NOISE_LEVEL and shares[0] <= SMALL_FORCE and shares[1] <= SMALL_MOMENT:
        return "good", f"the simulation of {where} misses nothing of importance"
    moment = f"up to {percent(shares[1])}".replace("up to over", "over")
    return (
        "fair",
        f"on {where} the simulation misses {percent(shares[0])} of the weight and {moment} of the rotors' moment",
    )


def _count(known: int, total: int) -> str:
    if known == total:
        return f"All {total} parameters"
    return f"{known} of {total} parameters" if known else f"None of {total} parameters"


def _details(known: Sequence[Json], judged: Sequence[Json]) -> tuple[str, ...]:
    out = []
    if known:
        widest = max(known, key=relative_halfwidth)
        out.append(f"The least certain is {widest['name']}, to {percent(relative_halfwidth(widest))} (95 % interval).")
    fits: list[str] = []
    for name, axis in (("p", "roll"), ("q", "pitch"), ("r", "yaw")):
        values = [v for s in judged if (v := s["fit_percent"].get(name)) is not None]
        fits += [f"{axis} {min(values):.0f} %" if min(values) >= -100.0 else f"{axis} below -100 %"] if values else []
    if fits:
        out.append(f"Fit over one second: {', '.join(fits)} (100 % is perfect, 0 % is no better than the mean).")
    return tuple(out)


def at_bounds(result: Json) -> list[str]:
    """Names of the parameters that a fit left on a bound, as its warnings tell."""
    names = [p["name"] for p in result["parameters"]]
    return [n for n in names if any(w.startswith(f"{n} = ") and "rests on its bound" in w for w in result["warnings"])]


def out_of_reach(result: Json) -> dict[str, str]:
    """Parameters that the channels of the logs cannot show, and why, as its warnings state it."""
    told = (w.partition(": the vehicle file's values are kept, because ") for w in result["warnings"])
    return {name: why for names, _, why in told if why for name in names.split(", ")}


def _next_steps(
    result: Json, open_ones: Sequence[Json], stuck: Sequence[str], ratio: float, adequate: bool
) -> tuple[str, ...]:
    out = []
    rough = not ratio <= ROUGH
    if rough:
        out.append(_DIAGNOSE)
    if _lacking(result["sets"]):
        out.append(f"To validate it, add another flight of {LEAST_SECONDS:g} s or more with --validate.")
    if stuck:
        out.append(
            f"Check rotor positions and order, command scale and bounds in the vehicle file: {', '.join(stuck)} "
            f"rest{'s' * (len(stuck) == 1)} on a bound."
        )
    # With the wrong model a parameter seems hidden that the flight shows well: more flying is no cure.
    beyond = out_of_reach(result)
    for why in dict.fromkeys(beyond.values()):
        names = ", ".join(name for name, other in beyond.items() if other == why)
        out.append(f"Log it better: {why}. Then {names} can be identified.")
    hidden = [] if rough else [p for p in open_ones if p["name"] not in stuck and p["name"] not in beyond]
    for p in hidden:
        if p["status"] == "prior_dominated":
            out.append(f"Fly {MOTION.get(p['name'], 'with more motion')}: {p['name']} is not observable in these data.")
    if hidden:
        out.append("`quadid excite` proposes a manoeuvre and predicts its gain.")
    if not adequate:
        out.append(_DIAGNOSE)
    if not out:
        out.append(
            "`quadid export` writes the values for PX4, ArduPilot, Gazebo or RotorPy. Nothing is sent to the vehicle."
        )
    return tuple(dict.fromkeys(out))


def reason(parameter: Json, stuck: Sequence[str] = ()) -> str:
    """Says in one sentence what the data say about a parameter; `stuck` as of `at_bounds`."""
    name, status = parameter["name"], parameter["status"]
    if name in stuck:
        return "At a bound of the vehicle file: the estimate lies outside, or an effect is missing."
    if decided_before(parameter):
        return f"{percent(_number(parameter['prior_share']))} of the information is from the vehicle file's sigma."
    if status == "prior_dominated":
        needs = MOTION.get(name)
        return "Not observable with this model and flight; the file keeps its guess." + (
            f" It needs {needs}." if needs else ""
        )
    if status == "unreliable":
        return "Not to be used: the model does not follow this flight, or parts of the flight yield different values."
    if status == "ratio_only":
        return f"Only its ratio to {parameter.get('relative_to', 'another parameter')} is known, not both."
    change = _number(parameter["value"]) / _number(parameter["initial"]) - 1.0 if parameter["initial"] else math.nan
    if not math.isfinite(change):
        return f"Known to {percent(relative_halfwidth(parameter))}."
    low, high = (_number(v) for v in parameter["ci95"])
    if low <= _number(parameter["initial"]) <= high:
        return f"Known to {percent(relative_halfwidth(parameter))}; the old value lies inside the interval."
    moved = "raised" if change > 0 else "lowered"
    return f"Known to {percent(relative_halfwidth(parameter))}; {moved} by {percent(abs(change))}."


def relative_halfwidth(parameter: Json) -> float:
    """Half of the 95 % interval relative to the value; infinite without an interval."""
    low, high = (_number(v) for v in parameter["ci95"])
    value = _number(parameter["value"])
    width = 0.5 * (high - low) / abs(value) if value else math.inf
    return width if math.isfinite(width) else math.inf


def percent(share: float) -> str:
    """A share as per cent with two digits that matter: 0.0123 -> 1.2 %."""
    if not math.isfinite(share):
        return "an unknown margin"
    value = 100.0 * share
    if value > 200.0:
        return "over 200 %"
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %"


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def digits(parameter: Json) -> int:
    """Digits that value and interval of a parameter need for two digits of the interval's half; from 4 to 9."""
    low, high = (_number(v) for v in parameter["ci95"])
    half, size = 0.5 * (high - low), abs(_number(parameter["value"]))
    if not (math.isfinite(half) and half > 0.0 and math.isfinite(size) and size > 0.0):
        return 4
    return min(max(math.floor(math.log10(size)) - math.floor(math.log10(half)) + 2, 4), 9)
