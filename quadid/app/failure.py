"""The report of an attempt that failed: why, what to do, and the data as they are."""

from collections.abc import Sequence
from dataclasses import asdict

from quadid_replay import open_log

from quadid.app.logs import parse_part
from quadid.app.outcome import LIBRARY, provenance
from quadid.checks import Inspection, inspect
from quadid.data.window import CHANNELS, Recording
from quadid.errors import QuadidError
from quadid.report.figures import WHOLE_POINTS, thinned
from quadid.report.page import axis, figure, raised, render, rows_of, section, trace
from quadid.report.verdict import Verdict
from quadid.types import JsonDict
from quadid.vehicle import Vehicle

MOST_FIGURES = 30
"""Channels of a log that are drawn."""
_WORDS = {"ok": "fine", "warning": "doubtful", "error": "wrong", "unknown": "not checked"}


def failure_html(
    error: QuadidError, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str, command: str = LIBRARY
) -> str:
    """The page as HTML.

    Args:
        what: what was asked for, for the title.
        texts: logs as they were given.
    """
    rows, sections = provenance([], command), list[JsonDict]()
    missing = []
    for i, text in enumerate(texts):
        try:
            recording = open_log(parse_part(text).path, preset)
        except (QuadidError, OSError) as unreadable:
            rows.append({"name": text, "value": f"cannot be read: {unreadable}"})
            continue
        rows.append({"name": text, "value": f"sha256 {recording.sha256 or 'unknown'}"})
        sections.append(_data(recording, i))
        try:
            found = inspect(recording, vehicle)
        except QuadidError as unclear:
            rows.append({"name": f"{text}, inspection", "value": str(unclear)})
            continue
        sections.append(_checks(recording.name, found, i))
        missing += [f"{m.channel}: {m.why}. To get it: {m.how}." for m in found.missing]
    fix = error.fix[:1].upper() + error.fix[1:]
    steps = [step for step in dict.fromkeys([fix, *missing]) if step]
    details = (f"Needed: {error.allowed}.",) if error.allowed else ()
    verdict = Verdict(
        "poor", f"No answer: {error.found}.", details, tuple(steps or ["`quadid inspect LOG` shows more."])
    )
    return render(
        {
            "title": f"{what}: no answer",
            "subtitle": "Nothing was identified. What the logs hold is shown as it was read.",
            "verdict": asdict(verdict),
            "sections": sections,
            "provenance": rows,
        }
    )


def _data(recording: Recording, place: int) -> JsonDict:
    """Every channel as it was read."""
    figures = []
    for i, (name, channel) in enumerate(recording.channels.items()):
        if len(channel.t) > 1 and i < MOST_FIGURES:
            rows = thinned(channel.values, WHOLE_POINTS)
            t, columns = channel.t[rows] - channel.t[0], channel.values[rows].T
            data = [trace(f"unit{k}", f"{name} {k + 1}", t, column) for k, column in enumerate(columns)]
            layout, title = {"xaxis": axis("time [s]")}, name.replace("_", " ")
            figures.append(figure(f"raw{place}-{i}", title, data, layout, 220, caption=raised(CHANNELS[name][1])))
    intro = f"{recording.format}, {len(recording.channels)} channels."
    if recording.warnings:
        intro += " Notes: " + "; ".join(recording.warnings) + "."
    return section(f"raw{place}", recording.name, intro, figures)


def _checks(log: str, found: Inspection, place: int) -> JsonDict:
    """Findings of the checks, and what the log allows."""
    rows = [[c.name.replace("_", " "), _WORDS[c.verdict.value], c.message, c.fix or "–"] for c in found.checks]
    outlook = [[o.parameter, "yes" if o.possible else "no", o.reason] for o in found.parameters]
    checks = rows_of(("Check", "Result", "Found", "What to do"), rows)
    return section(
        f"checks{place}", f"What {log} allows", "", (), [checks, rows_of(("Parameter", "Possible", "Why"), outlook)]
    )
