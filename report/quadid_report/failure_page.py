"""The page when there is no answer: why, what to do, and the data as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from quadid.inspection import Inspection
from quadid.types import Json
from quadid.window import CHANNELS, Channel, Recording
from quadid_report.figures import WHOLE_POINTS, thinned
from quadid_report.parts import axis, rows_of, section, short
from quadid_report.verdict import Verdict

MOST_FIGURES = 30
_WORDS = {"ok": "fine", "warning": "doubtful", "error": "wrong", "unknown": "not checked"}


def failure_page(
    what: str, why: str, fix: str, logs: Sequence[tuple[Recording, Inspection | None]],
    provenance: Sequence[Json], allowed: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Builds the page.

    Args:
        what: what was asked for, for the title.
        why: what was found.
        fix: what to do.
        logs: what could be read, with its inspection.
        provenance: rows of name and value.
        allowed: what would have been valid.
    """
    steps = [text for text in (fix[:1].upper() + fix[1:], *_missing(logs)) if text]
    details = (f"Needed: {allowed}.",) if allowed else ()
    verdict = Verdict("poor", f"No answer: {why}.", details, tuple(steps or ["`quadid inspect LOG` shows more."]))
    sections: list[dict[str, Any]] = []
    for i, (recording, inspection) in enumerate(logs):
        sections.append(_data(recording, i))
        if inspection is not None:
            sections.append(_checks(recording, inspection, i))
    return {
        "title": f"{what}: no answer",
        "subtitle": "Nothing was identified. What the logs hold is shown as it was read.",
        "verdict": asdict(verdict),
        "sections": sections,
        "provenance": provenance,
    }


def _missing(logs: Sequence[tuple[Recording, Inspection | None]]) -> list[str]:
    found = [m for _, inspection in logs if inspection is not None for m in inspection.missing]
    return [f"{m.channel}: {m.why}. To get it: {m.how}." for m in dict.fromkeys(found)]


def _data(recording: Recording, number: int) -> dict[str, Any]:
    figures = [
        _figure(name, channel, f"raw{number}-{i}")
        for i, (name, channel) in enumerate(recording.channels.items())
        if len(channel.t) > 1 and i < MOST_FIGURES
    ]
    intro = f"{recording.format}, {len(recording.channels)} channels."
    if recording.warnings:
        intro += " Notes: " + "; ".join(recording.warnings) + "."
    return section(f"raw{number}", recording.name, intro, figures)


def _figure(name: str, channel: Channel, identifier: str) -> dict[str, Any]:
    values = channel.values.reshape(len(channel.t), -1)
    rows = thinned(values, WHOLE_POINTS)
    data = [
        {
            "role": f"unit{i}", "name": f"{name} {i + 1}", "type": "scatter", "mode": "lines",
            "y": short(np.asarray(values[rows, i], dtype=np.float64)),
        }
        for i in range(values.shape[1])
    ]  # fmt: skip
    t = short(np.asarray(channel.t[rows] - channel.t[0], dtype=np.float64))
    views = [{"label": "", "x": t, "data": data, "layout": {"xaxis": axis("time [s]")}}]
    title, caption = name.replace("_", " "), CHANNELS[name][1]
    return {"id": identifier, "title": title, "caption": caption, "views": views, "height": 220}


def _checks(recording: Recording, inspection: Inspection, number: int) -> dict[str, Any]:
    rows = [[c.name.replace("_", " "), _WORDS[c.verdict.value], c.message, c.fix or "–"] for c in inspection.checks]
    outlook = [[o.parameter, "yes" if o.possible else "no", o.reason] for o in inspection.parameters]
    tables = [
        rows_of(("Check", "Result", "Found", "What to do"), rows), rows_of(("Parameter", "Possible", "Why"), outlook),
    ]  # fmt: skip
    return section(f"checks{number}", f"What {recording.name} allows", tables=tables)
