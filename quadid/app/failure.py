"""The report of an attempt that failed: why, what to do, and the data as they are."""

from collections.abc import Sequence
from dataclasses import asdict

from quadid_replay import open_log

from quadid.app.logs import parse_part
from quadid.app.outcome import LIBRARY, provenance
from quadid.checks import inspect
from quadid.data.window import CHANNELS
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
    rows, sections, missing = provenance([], command), list[JsonDict](), list[str]()
    for i, text in enumerate(texts):
        try:
            recording = open_log(parse_part(text).path, preset)
        except (QuadidError, OSError) as unreadable:
            rows.append({"name": text, "value": f"cannot be read: {unreadable}"})
            continue
        rows.append({"name": text, "value": f"sha256 {recording.sha256 or 'unknown'}"})
        # Every channel as it was read.
        figures, flown = [], [(n, c) for n, c in recording.channels.items() if len(c.t) > 1]
        for k, (name, channel) in enumerate(flown[:MOST_FIGURES]):
            kept = thinned(channel.values, WHOLE_POINTS)
            t, columns = channel.t[kept] - channel.t[0], channel.values[kept].T
            data = [trace(f"unit{j}", f"{name} {j + 1}", t, column) for j, column in enumerate(columns)]
            layout, title, unit = {"xaxis": axis("time [s]")}, name.replace("_", " "), raised(CHANNELS[name][1])
            figures.append(figure(f"raw{i}-{k}", title, data, layout, 220, caption=unit))
        notes = f" Notes: {'; '.join(recording.warnings)}." if recording.warnings else ""
        intro = f"{recording.format}, {len(recording.channels)} channels.{notes}"
        sections.append(section(f"raw{i}", recording.name, intro, figures))
        # Findings of the checks, and what the log allows.
        try:
            found = inspect(recording, vehicle)
        except QuadidError as unclear:
            rows.append({"name": f"{text}, inspection", "value": str(unclear)})
            continue
        judged = [[c.name.replace("_", " "), _WORDS[c.verdict.value], c.message, c.fix or "–"] for c in found.checks]
        outlook = [[o.parameter, "yes" if o.possible else "no", o.reason] for o in found.parameters]
        checks = rows_of(("Check", "Result", "Found", "What to do"), judged)
        allowed = rows_of(("Parameter", "Possible", "Why"), outlook)
        sections.append(section(f"checks{i}", f"What {recording.name} allows", tables=[checks, allowed]))
        missing += [f"{m.channel}: {m.why}. To get it: {m.how}." for m in found.missing]
    fix = error.fix[:1].upper() + error.fix[1:]
    steps = [step for step in dict.fromkeys([fix, *missing]) if step]
    details = (f"Needed: {error.allowed}.",) if error.allowed else ()
    shown = tuple(steps or ["`quadid inspect LOG` shows more."])
    page = {
        "title": f"{what}: no answer",
        "subtitle": "Nothing was identified. What the logs hold is shown as it was read.",
        "verdict": asdict(Verdict("poor", f"No answer: {error.found}.", details, shown)),
    }
    return render({**page, "sections": sections, "provenance": rows})
