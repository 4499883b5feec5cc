"""Pages of identification, diagnosis, manoeuvre and failure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from markupsafe import Markup
from scipy.signal import welch

from quadid.checks.motion import Spans, flying_spans, within
from quadid.data.rotor_signal import rotor_channel
from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS, CHANNELS, Channel, Recording, sample_period
from quadid.effects import EFFECTS
from quadid.estimate.missing import Missing
from quadid.identification.noise import NoiseModel
from quadid.identification.result import SCORE_SECONDS, ScoredSet
from quadid.identification.uncertainty import Excitation
from quadid.parameters import ParameterSet
from quadid.report.figures import (
    MODELS,
    MOST_LOGS,
    WHOLE_POINTS,
    ResidualMap,
    channel_figures,
    error_figure,
    gain_figure,
    map_figure,
    missing_figures,
    parameter_figure,
    thinned,
)
from quadid.report.page import axis, figure, fit, measures, number, part, quiet, rows_of, section, trace, unit, upright
from quadid.report.verdict import (
    MOTION,
    NOISE_LEVEL,
    Level,
    Verdict,
    at_bounds,
    digits,
    parameter_name,
    percent,
    reason,
    relative_halfwidth,
    status_words,
)
from quadid.types import FloatArray, Json, JsonDict
from quadid.vehicle import Vehicle

# --- Contents of a log beside the outputs: flight modes, and the spectrum of its vibration


SECONDS = 2.0
"""Length of the stretches whose spectra are averaged: lines half a hertz apart are resolved."""
MOST_POINTS = 400


def flight_section(recording: Recording, vehicle: Vehicle, place: int) -> dict[str, Any] | None:
    """Modes and vibration of one log as a section of a page; None where it has neither.

    Args:
        recording: as read, each channel at its own rate.
    """
    figures, said = list[JsonDict](), ""
    rotors, _ = rotor_channel(recording, vehicle)
    # The rotor signal over the whole log, as it was read.
    if rotors is not None and len(rotors.t) > 1:
        rows = thinned(rotors.values, WHOLE_POINTS)
        t, signal = rotors.t[rows] - recording.first_imu_time, rotors.name.replace("_", " ")
        data = [trace(f"unit{i}", f"rotor {i + 1}", t, column) for i, column in enumerate(rotors.values[rows].T)]
        layout: JsonDict = {"xaxis": axis("time [s]"), "yaxis": axis(f"{signal} [{CHANNELS[rotors.name][1]}]")}
        figures.append(figure(f"log{place}-rotors", "Rotor signals", data, layout, 280))
    # Amplitude spectrum of the accelerometer in the air, and where the rotors are in it.
    spans, accel = flying_spans(recording, vehicle), recording.channels.get("accel")
    if spans and accel is not None and (found := spectrum(accel, spans)) is not None:
        frequency, density = found
        roles = zip(("measured", "before", "after"), ("forward", "to the right", "downwards"), strict=True)
        data = [trace(role, name, frequency, density[:, i]) for i, (role, name) in enumerate(roles)]
        shown, said = _turning(rotors, spans, float(frequency[-1]))
        scale = axis("(m/s²)/√Hz", type="log")
        layout = {"xaxis": axis("frequency (Hz)"), "yaxis": scale, "shapes": [upright(turns) for turns in shown]}
        figures.append(figure(f"log{place}-vibration", "Vibration in the air", data, layout, 300))
    modes = mode_rows(recording)
    if not figures and not modes:
        return None
    tables = [rows_of(("flight mode", "from (s)", "to (s)"), modes)] if modes else []
    return section(f"flight-{place}", f"Flight of {recording.name}", said, figures, tables, kind="folded")


def mode_rows(recording: Recording) -> list[list[str]]:
    """Flight modes with the times between which they held [s after the first IMU sample]."""
    imu = [c.t for n, c in recording.channels.items() if n in ("gyro", "accel")]
    if not recording.modes or not imu:
        return []
    zero, end = min(float(t[0]) for t in imu), max(float(t[-1]) for t in imu)
    starts = [t for t, _ in recording.modes]
    held = zip(recording.modes, [*starts[1:], end], strict=True)
    return [
        [name, f"{max(begin - zero, 0.0):.1f}", f"{stop - zero:.1f}"] for (begin, name), stop in held if stop > zero
    ]


def spectrum(accel: Channel, spans: Spans) -> tuple[FloatArray, FloatArray] | None:
    """Amplitude spectral density of the specific force, averaged over the flight (Welch).

    Args:
        accel: at its own rate.
        spans: when it flies [s].

    Returns:
        Frequencies [Hz], shape (n,), and densities [(m/s^2)/sqrt(Hz)], shape (n, 3); None where no stretch is long
        enough.
    """
    rate = 1.0 / sample_period(accel.t)
    rows = round(SECONDS * rate)
    parts = [accel.values[(accel.t >= a) & (accel.t <= b)] for a, b in spans]
    parts = [p for p in parts if len(p) >= rows]
    if rows < 8 or not parts:
        return None
    each = [welch(p, rate, nperseg=rows, axis=0) for p in parts]
    power = np.average([p for _, p in each], axis=0, weights=[len(p) for p in parts])
    keep = np.unique(np.linspace(1, len(power) - 1, MOST_POINTS).astype(int))
    return each[0][0][keep], np.sqrt(power[keep])


def _turning(rotors: Channel | None, spans: Spans, highest: float) -> tuple[list[float], str]:
    """Frequency at which the mean rotor speed in flight shows in a spectrum [Hz], if it does, and that in words."""
    if rotors is None or rotors.name != "rotor_speed":
        return [], "The rotor speed is not logged; peaks are most often rotors out of balance."
    turns = float(np.mean(rotors.values[within(rotors.t, spans)])) / (2.0 * np.pi)
    if turns <= highest:
        return [turns], f"The rotors turn {turns:.0f} times a second (dashed): a peak there is imbalance."
    folded = abs(turns - 2.0 * highest * round(turns / (2.0 * highest)))
    return [], (
        f"The rotors turn {turns:.0f} times a second, faster than this log can show ({highest:.0f} Hz): without a "
        f"filter before sampling their imbalance appears at {folded:.0f} Hz."
    )


# --- What a flight can tell about each parameter, what limits it, and what to fly next


SHARP = 0.02
"""Relative standard deviation below which more flying gains nothing that anybody needs."""
COUPLED = 5.0
"""From this ratio on, it is the coupling with other parameters that limits, not the motion."""
_HEAD = ("Parameter", "Best achievable σ", "If all others were known", "Manoeuvre needed")


def excitation_part(found: Excitation, seconds: float) -> dict[str, Any]:
    """The section of the page as plain data.

    Args:
        found: bounds from the flight.
        seconds: length of the flight that they were computed from.
    """
    rows = [
        (name, _sigma(bound), _sigma(alone), _advice(name, bound, alone, seconds))
        for name, bound, alone in zip(found.names, found.bound.tolist(), found.alone.tolist(), strict=True)
    ]
    intro = (
        f"Smallest possible standard deviation from these {seconds:.0f} s, whatever the method, were the model right "
        "(Cramér–Rao bound): with all parameters unknown, and with all others known. If they differ much, the flight "
        "couples parameters."
    )
    table = rows_of(_HEAD, rows, classes=("", "number", "number", ""))
    done = ["Nothing more needs to be flown for these."] if np.all(found.bound <= SHARP) else []
    return section("excitation", "What to fly next", intro, (), [table], after=done)


def _sigma(bound: float) -> str:
    if not math.isfinite(bound) or bound > 10.0:
        return "not at all"
    return percent(bound).replace(" ", "\u00a0")


def _advice(name: str, bound: float, alone: float, seconds: float) -> str:
    if bound <= SHARP:
        return "nothing more"
    motion = MOTION.get(name, "more motion")
    if not math.isfinite(bound) or bound > 10.0:
        return f"{motion}: this flight does not show it"
    if bound > COUPLED * alone:
        return f"{motion}, so that it moves apart from the others"
    # A deviation falls with the square root of the time flown.
    need = seconds * (bound / SHARP) ** 2
    return f"{motion}; flown like this, {percent(SHARP)} would take {need:.0f} s"


# --- The page of an identification: its parts, as `render` wants them


FIT_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_z")


def identify_sections(
    result: Json,
    sets: Sequence[ScoredSet],
    lacking: Json | None,
    more: Sequence[Json],
    after: Sequence[Json],
    truth: Mapping[str, float] | None = None,
) -> list[Json]:
    """Sections of the page of an identification.

    Args:
        result: of the form ``quadid.identify/1``.
        sets: the scored logs in the order of ``result["sets"]``.
        lacking: of `missing_section`.
        more: sections below the parameters.
        after: sections below the prediction.
        truth: true parameters of a simulation, where there is one.
    """
    parameters, entries = result["parameters"], result["sets"]
    shown = parameter_section(parameters, truth, at_bounds(result), [parameter_figure(parameters, truth)])
    # Errors of every log before and after, and how well channels fit
    names = [n for n in FIT_NAMES if any(n in s["fit_percent"] for s in entries)]
    head = ("Log", "Used for", "Error before", "Error after", *(f"Fit {n}" for n in names))
    rows = []
    for s in entries:
        use, errors = "fitting" if s["role"] == "train" else "validation", (s["mse"]["initial"], s["mse"]["fitted"])
        fits = (fit(s["fit_percent"].get(n)) for n in names)
        rows.append((s["log"], use, *(number(error, 3) for error in errors), *fits))
    table = rows_of(head, rows, classes=("", "", "number", "number strong", *["number"] * len(names)))
    # The first few logs with their figures, unseen ones first
    parts, drawn = [], min(len(sets), MOST_LOGS)
    ordered = sorted(zip(entries, sets, strict=True), key=lambda pair: pair[0]["role"] == "train")
    for i, (entry, scored) in enumerate(ordered[:drawn]):
        each = ((n, number(e["value"], 3), unit(e["unit"])) for n, e in entry["rmse"].items())
        found = [(*known, fit(entry["fit_percent"].get(known[0]))) for known in each]
        channels = measures(("Channel", "Root mean squared error", "Unit", "Fit"), found, (1, 3))
        figures = [error_figure(scored, f"log{i}-error"), *channel_figures(scored, f"log{i}", drawn)]
        name, kind = _named(entry["log"], entry["role"]), "folded" if i else "open"
        parts.append(part(name, "", figures, [channels], lines=[quiet(_KEYS, "quiet hint")], kind=kind))
    title = "How well the simulation predicts"
    predicted = section("fit", title, _PREDICTION, (), [table], parts=parts, menu="Prediction")
    return [*([lacking] if lacking else []), shown, *more, predicted, *after]


_APPLIED = "Nothing has been applied to any vehicle. The interval is where the value lies in 95 of 100 such flights."
_PREDICTION = (
    "The simulation runs for one second at a time from an estimated start, then is compared with the measurement. "
    "Error: mean squared prediction error, relative to what the model expects (1: as large as expected). Fit: 100 % is "
    "a perfect curve, 0 % no better than the mean; a channel that is mostly noise stays far below 100 %."
)
_KEYS = (
    "Drag to zoom, double-click to come back, click a name to hide it. With the keyboard: + and − zoom, ← and → move, "
    "0 shows all."
)


def parameter_section(
    parameters: Sequence[Json],
    truth: Mapping[str, float] | None = None,
    stuck: Sequence[str] = (),
    figures: Sequence[Json] = (),
) -> JsonDict:
    """Every parameter with its interval, status and reason, and the truth where it is known; then pictures."""
    head = ["Parameter", "Current", "Proposed", "95 % interval", "Unit", "Status", "Reason"]
    classes = ["", "number", "number strong", "number", "", "", "reason"]
    rows = []
    for p in parameters:
        n, margin = digits(p), percent(relative_halfwidth(p)).replace(" ", "\u00a0")
        low, high = (number(v, n) for v in p["ci95"])
        interval = Markup("{} … {} {}").format(low, high, quiet(f"(±{margin})", "quiet nobreak"))
        chip = Markup('<span class="chip {}">{}</span>').format(p["status"], status_words(p))
        values = (number(p["initial"]), number(p["value"], n), interval)
        why = reason(p, stuck).replace(" %", "\u00a0%")
        rows.append([parameter_name(p["name"]), *values, unit(p["unit"]), chip, why])
    if truth:
        for column, cell in ((head, "Truth"), (classes, "number")):
            column.insert(4, cell)
        for row, p in zip(rows, parameters, strict=True):
            row.insert(4, number(truth.get(p["name"])))
    table = rows_of(head, rows, classes=classes)
    below = part(figures=figures, after=[quiet(_APPLIED)])
    return section("parameters", "Parameters", tables=[table], parts=[below], kind="plain")


def _named(log: str, role: str, what: str = "") -> Markup:
    """A log as a title: its name, what is shown of it, and what it was used for."""
    return Markup("{}{} {}").format(log, what, quiet(f"({'fitted' if role == 'train' else 'validation'})"))


def quality_section(logs: Sequence[Json], noise: NoiseModel) -> JsonDict:
    """Used parts of every log, and the standard deviations of the white and the slow part of the sensor noise."""
    each = zip(CHANNEL_NAMES, noise.white, noise.slow, CHANNEL_UNITS, strict=False)
    rows = [(name, number(float(white), 3), number(float(slow), 3), unit(of)) for name, white, slow, of in each]
    deviations = measures(("Channel", "White", "Slow", "Unit"), rows, (1, 2))
    sensors = part("Sensor noise, estimated from the flight", tables=[deviations])
    return section("quality", "Data quality", parts=[*logs, sensors])


def correlation_section(parameters: ParameterSet) -> dict[str, Any]:
    """Correlations of the parameters: near 1 or -1, the flight hardly separates two of them."""
    names, values = list(parameters.names), parameters.correlation
    text = [[f"{v:+.2f}" for v in row] for row in values]
    data = [{
        "role": "measured", "name": "correlation", "type": "heatmap", "x": names, "y": names,
        "z": values.round(3).tolist(), "zmin": -1, "zmax": 1, "text": text, "texttemplate": "%{text}",
        "hoverinfo": "skip", "showscale": False,
    }]  # fmt: skip
    layout = {"xaxis": {"type": "category"}, "yaxis": {"type": "category", "autorange": "reversed"}}
    intro = "Near +1 or -1 the flight hardly separates two parameters: fly what moves one of them alone."
    return section("correlations", "Correlations", intro, [figure("correlations", "Correlations", data, layout, 320)])


# --- The page of a diagnosis, and the part that other pages take from it


HELD_OUT = "held-out blocks"
"""Data on which a diagnosis without validation logs measures its gain."""
_LEVELS: dict[str, Level] = {
    "nothing_found": "good",
    "explained": "good",
    "partly_explained": "fair",
    "unknown": "poor",
}


def diagnose_verdict(result: Json) -> Verdict:
    """Judges a result of the form ``quadid.diagnose/1``."""
    # Confident findings by name: those to do something about, and those no larger than on most vehicles.
    sure, verdict = [f for f in result["findings"] if f["confident"]], result["verdict"]
    large = [f["effect"].replace("_", " ") for f in sure if not f.get("ordinary")]
    small = [f["effect"].replace("_", " ") for f in sure if f.get("ordinary")]
    headline = result["statement"]
    if (large or small) and verdict != "unknown":
        found = [", ".join(large)] if large else []
        found += [f"no larger than on most vehicles: {', '.join(small)}"] if small else []
        headline = f"Found: {'; '.join(found)}. {headline}"
    v = result["validation"]
    held_out = v.get("on") == HELD_OUT
    where = "held-out blocks of the same flight" if held_out else "validation flights"
    change = _change(v, bool(result["findings"]))
    missing = (result.get("missing") or {}).get("statement")
    details = [missing] if missing else []
    details.append(f"The error on {where} {change} noise variances (1 is the noise floor).")
    deciding = v.get("deciding")
    if result["findings"] and deciding and deciding["seconds"] != SCORE_SECONDS:
        chosen = f"In simulations of {deciding['seconds']:g} s, on which the causes were chosen, it"
        details.append(f"{chosen} {_change(deciding, True)}.")
    level, left = _LEVELS[verdict], v.get("mse_extended_refitted") or v["mse_extended"]
    steps = _next_steps(result)
    if level == "good" and (held_out or left is None or left > NOISE_LEVEL):
        level = "fair"
    if held_out:
        details.append("Not validated: no unseen flight was given.")
        steps = ("To validate it, add another flight with --validate.", *steps)
    return Verdict(level, headline, tuple(details), steps)


def _change(errors: Json, found: bool) -> str:
    """Error without and with the findings."""
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


def _next_steps(result: Json) -> tuple[str, ...]:
    sure = [f["effect"] for f in result["findings"] if f["confident"] and not f.get("ordinary")]
    out = []
    for effect in [name for name in sure if name in EFFECTS][:3]:
        advice = EFFECTS[effect].advice
        out.append(f"{effect.replace('_', ' ').capitalize()}: {advice[0].lower()}{advice[1:]}")
    if result["verdict"] in ("partly_explained", "unknown"):
        where = f"is in {', '.join(result['unexplained'])}" if result["unexplained"] else "is spread over all channels"
        out.append(f"The unexplained error {where}: a livelier flight (`quadid excite`) may show its cause.")
    if result["findings"]:
        out.append("The extended vehicle file works with every other command, for example `quadid score`.")
    else:
        out.append("Nothing to change. A livelier flight shows more: `quadid excite`.")
    return tuple(out)


def diagnosis_part(
    result: Json,
    sets: Sequence[ScoredSet] = (),
    prefix: str = "d",
    title: str = "",
    intro: str = "",
    maps: Mapping[str, ResidualMap] | None = None,
    missing: Json | None = None,
    judged: bool = True,
) -> dict[str, Any]:
    """A diagnosis as part of a page: verdict, findings, pictures.

    Args:
        result: of the form ``quadid.diagnose/1``.
        sets: logs scored without (`initial`) and with (`fitted`) the findings.
        prefix: makes identifiers of figures unique on the page.
        maps: what each cause looks like in the residual, by name of the effect.
        missing: of `missing_section`, whose figures are shown.
        judged: with its verdict.
    """
    findings = [
        finding_part(finding, result["validation"]["noise_floor"], f"{prefix}-{i}", (maps or {}).get(finding["effect"]))
        for i, finding in enumerate(result["findings"])
    ]
    pictured = list(sets)[:MOST_LOGS] if findings else []
    logs = [
        part(
            _named(s.log, s.role, ": the simulation with and without what was found"),
            figures=[
                error_figure(s, f"{prefix}-log{i}-error", MODELS),
                *channel_figures(s, f"{prefix}-log{i}", len(pictured) + 2, MODELS),
            ],
            kind="folded",
        )
        for i, s in enumerate(pictured)
    ]
    lacking = [] if missing is None else [part("", missing["intro"], missing["figures"])]
    verdict = asdict(diagnose_verdict(result)) if judged else None
    inner = [*lacking, *findings, *remaining(result, sets), *logs]
    return part(title, lines=[intro], verdict=verdict, parts=inner, kind="chapter")


def findings_section(diagnoses: Sequence[Json]) -> JsonDict:
    """Diagnoses as a section of a page."""
    return section("findings", "What the simulation gets wrong", parts=diagnoses, menu="What is wrong", kind="plain")


_REMARKS = {
    "per_log": "It belongs to this flight, not to the vehicle: another flight has its own.",
    "ordinary": "It is no larger than on most vehicles and is therefore listed after larger causes.",
}


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
    before, after = gain["mse_before"], gain["mse_after"]
    less = _short(None if before is None or after is None else before - after)
    gained = f"The error of {gain['seconds']:g} s runs on unseen data falls by {less} noise variances"
    if low is not None and high is not None:
        gained += f" (95 % interval {low:.3g} to {high:.3g})"
    gained += "." if finding["p_value"] is None else f"; {chance(finding['p_value'])}."
    if before and after:
        without, having = (percent(min(floor / error, 1.0)) for error in (before, after))
        noise = "Share of the error that is sensor noise, which no model can remove"
        gained += f" {noise}: {without} without {name}, {having} with."
    rivals = [f"{a['effect'].replace('_', ' ')} ({_short(a['mse_after'])})" for a in finding["alternatives"]]
    rejected = (
        f"Rejected alternatives, with the error they leave: {', '.join(rivals)}."
        if rivals
        else "No other cause of the catalogue came near it."
    )
    unsure = Markup("") if finding["confident"] else Markup(' <span class="chip prior_dominated">not certain</span>')
    # Advice about a cause, and what sets it apart
    known = EFFECTS.get(finding["effect"])
    parts = [] if known is None or finding.get("ordinary") else [known.advice]
    return part(
        Markup("{}{}").format(name, unsure),
        figures=[
            *([map_figure(seen, f"{identifier}-map", name)] if seen is not None else []),
            gain_figure(finding, floor, f"{identifier}-gain"),
        ],
        lines=[
            finding["evidence"],
            Markup("").join(map(_value, finding["parameters"])),
            " ".join([*parts, *(text for key, text in _REMARKS.items() if finding.get(key))]).strip(),
        ],
        after=[gained, quiet(rejected)],
        kind="finding",
    )


def _value(p: Json) -> Markup:
    """A number of a cause with its interval."""
    if p["name"] == "rotor":
        return Markup('<span class="value"><b>rotor {}</b></span>').format(int(p["value"]))
    low, high = (number(v, digits(p)) for v in p["ci95"])
    size = Markup("{} = <b>{}</b> {}").format(
        p["name"], number(p["value"], digits(p)), unit(p["unit"]) if p["unit"] else ""
    )
    return Markup('<span class="value">{} {}</span>').format(size, quiet(f"({low} … {high})"))


def missing_section(missing: Json, log: str, parts: Mapping[str, Sequence[Missing]]) -> dict[str, Any]:
    """The missing force and moment as part of a page: over time on one log, and by axis over the deciding logs.

    Args:
        missing: ``force`` and ``moment`` of contract §7, over the deciding logs.
        log: name of the one that is drawn.
        parts: its stretches by model.
    """
    models, rows = list(parts), []
    head = ["without the findings", "with the findings"] if len(models) > 1 else ["rms"]
    for key in ("force", "moment"):
        entry = missing[key]
        for a in "xyz":
            of = entry["of"] if key == "force" else entry["of"][a]
            cells = [f"{number(entry[m][a], 2)} {unit(entry['unit'])}, {percent(entry[m][a] / of)}" for m in models]
            rows.append((f"{key} {a}", *cells, f"{number(of, 3)} {unit(entry['unit'])} ({entry['of_what']})"))
    table = rows_of(
        ["", *head, "of"],
        rows,
        "Size by axis (rms, body axes), with its share",
        classes=["", *["number"] * len(models), ""],
    )
    how = "estimated with random forces in the model, in body axes"
    intro = f"{log}, {how}. The band contains the true value 95 % of the time."
    title = "Force and moment that the simulation misses"
    return section("missing", title, intro, missing_figures(parts, "missing"), [table], menu="What is missing")


def remaining(result: Json, sets: Sequence[ScoredSet]) -> list[JsonDict]:
    """Rest of the error: by channel, and what it follows."""
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
    if not rows and not follows:
        return [part(lines=["The rest is indistinguishable from noise."])]
    head = ("Channel", "Share of its error beyond noise", "Root mean squared error", "Unit")
    tables = [measures(head, rows, (1, 2))] if rows else []
    after = [f"What the rest follows: {'; '.join(follows)}."] if follows else []
    return [part("What remains, and where" if rows else "", tables=tables, after=after)]
