"""The trend that `quadid fleet` shows an owner: recorded flights of one damage that grows, as the flights of a vehicle.

Healthy flights of the airframe come first, then cuts by size; a file's date is its place in that order.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from scipy.stats import spearmanr

from quadid.app.health import has_changed
from quadid_evaluation.studies.health.recorded import LARGE, Flown

SERIES: tuple[tuple[str, str, frozenset[int]], ...] = (
    ("E8, M3", "E8", frozenset({3})),
    ("E9, M3", "E9", frozenset({3})),
    ("E9, M1 and M2", "E9", frozenset({1, 2})),
)
"""Vehicles of the fleet: name, airframe and the rotors that are cut ever shorter."""
_DAY = 86400.0
_FIRST = 1.7e9


def in_order(flights: Sequence[Flown], airframe: str, rotors: frozenset[int]) -> list[Flown]:
    """Healthy flights of an airframe and those with these rotors cut, by millimetres in all."""
    mine = [f for f in flights if f.airframe == airframe and (f.condition == "healthy" or f.rotors == rotors)]
    return sorted((f for f in mine if f.condition in ("healthy", "cut")), key=lambda f: (f.total, f.file))


def text(flights: Sequence[Flown], data: Path, report: Path | None = None) -> str:
    """Runs the command on all series and says what their trends show, as Markdown.

    Args:
        flights: all recorded ones.
        data: folder of their files.
        report: where to put the page that the command writes; None to drop it.
    """
    with TemporaryDirectory() as place:
        logs, out = Path(place) / "logs", Path(place) / "out"
        out.mkdir()
        for name, airframe, rotors in SERIES:
            (logs / name).mkdir(parents=True)
            for k, flown in enumerate(in_order(flights, airframe, rotors)):
                copy = shutil.copy(data / flown.file, logs / name)
                os.utime(copy, (_FIRST + _DAY * k, _FIRST + _DAY * k))
        command = [Path(sys.executable).with_name("quadid"), "fleet", logs, "--vehicle", "crazyflie"]
        subprocess.run([*command, "--out", out, "--json", out / "fleet.json"], check=True, stdout=subprocess.DEVNULL)
        rows = json.loads((out / "fleet.json").read_text(encoding="utf-8"))["health"]
        if report is not None:
            shutil.copy(out / "fleet.html", report)
    millimetres = {f.file: f.total for f in flights}
    lines = [
        "| vehicle | flights (baseline) | changed: healthy, below 3 mm, from 3 mm | first, all from [mm] | order |",
        "|---|---|---|---|---|",
    ]
    for name, *_ in SERIES:
        mine = [{**row, "mm": millimetres[Path(row["log"]).name]} for row in rows if row["unit"] == name]
        lines.append(_line(name, mine))
    return "\n".join(lines)


def _line(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    judged = [row for row in rows if not row["baseline"]]
    changed = [has_changed(row) for row in judged]
    cells = []
    for low, high in ((0.0, 0.1), (0.1, LARGE), (LARGE, 99.0)):
        part = [c for c, row in zip(changed, judged, strict=True) if low <= row["mm"] < high]
        cells.append(f"{sum(part)} of {len(part)}")
    missed = [row["mm"] for c, row in zip(changed, judged, strict=True) if not c]
    first = next((f"{row['mm']:g}" for c, row in zip(changed, judged, strict=True) if c), "none")
    after = next((f"{row['mm']:g}" for row in judged if row["mm"] > max(missed, default=-1.0)), "none")
    order = spearmanr([row["mm"] for row in judged], [row["score"] for row in judged])[0]
    return f"| {name} | {len(rows)} ({len(rows) - len(judged)}) | {', '.join(cells)} | {first}, {after} | {order:.2f} |"
