"""The result of a campaign as a page with tables and pictures."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadid.effects import EFFECTS
from quadid_evaluation.studies.campaign import summary
from quadid_evaluation.studies.campaign.grading import Graded, right

COMMAND = "python -m quadid_evaluation.studies.campaign --out docs/results"
NEAR = 0.05
"""Relative error below which an effect has no row of its own."""


def write(graded: Sequence[Graded], folder: Path, command: str = COMMAND) -> Path:
    """Writes `diagnosis.md` and its pictures into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = {g.case.group: [x for x in graded if x.case.group == g.case.group] for g in graded}
    parts = [
        "# Diagnosis: blinded campaign\n",
        f"{len(graded)} cases, `{command}`, {datetime.date.today().isoformat()}. Class and number of a case are its "
        "seed. Flights of 120 s unless said otherwise; intervals in brackets are exact 95 % binomial ones.\n",
        _classes(groups),
    ]
    singles = groups.get("single", [])
    if singles:
        parts += [_parameters(singles), _oracle(groups), "## First finding\n"]
        confusion(singles, folder / "diagnosis-confusion.png")
        parts.append("![Hidden effect against first finding](diagnosis-confusion.png)\n")
    sizes = {float(k.split("_")[1]): v for k, v in groups.items() if k.startswith("size_")}
    if sizes:
        detection({**sizes, 1.0: singles}, folder / "diagnosis-detection.png")
        parts += ["## How small an effect is found\n", "![Detection curve](diagnosis-detection.png)\n"]
    parts.append(_misses(graded))
    page = folder / "diagnosis.md"
    page.write_text("\n".join(parts), encoding="utf-8")
    return page


def _classes(groups: dict[str, list[Graded]]) -> str:
    rows = [
        "| class | all found | nothing else named | correct | verdicts | median [s] |",
        "|---|---|---|---|---|---|",
    ]
    for name, graded in groups.items():
        hides = name not in ("null", "outside")
        cells = [
            _count(summary.all_found(graded)) if hides else "–",
            _count(summary.nothing_else(graded)),
            str(summary.wholly_right(graded)),
            summary.verdicts(graded),
            f"{np.median([g.seconds for g in graded]):.1f}",
        ]
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    note = (
        "\nCorrect: exactly the hidden effects are named; nothing on a null; no confident name for an effect outside "
        "the catalogue; in clutter (every effect at a twentieth of its size, one large) the large one first.\n"
    )
    return "## By class\n\n" + "\n".join(rows) + "\n" + note


def _count(share: summary.Share) -> str:
    return f"{share.k} of {share.n}"


def _parameters(singles: Sequence[Graded]) -> str:
    errors, inside = summary.parameter_errors(singles), summary.coverage(singles)
    rows = [
        "| effect | found | median error % | largest error % | truth in the 95 % interval |",
        "|---|---|---|---|---|",
    ]
    for effect, values in errors.items():
        held = inside.get(effect)
        if max(values) < NEAR and held and held.k + 1 >= held.n:
            continue
        rows.append(f"| {effect} | {_sizes(values)} | {_count(held) if held else '–'} |")
    everything = [e for v in errors.values() for e in v]
    total = summary.Share(sum(s.k for s in inside.values()), sum(s.n for s in inside.values()))
    rows.append(f"| **all** | {_sizes(everything)} | {total} |")
    head = f"Effects always found within {NEAR:.0%}, at most one number outside its interval, are left out."
    return f"## Parameters of the effects\n\n{head}\n\n" + "\n".join(rows) + "\n"


def _sizes(errors: Sequence[float]) -> str:
    """Cells of a table: how many relative errors, the middle one, the largest."""
    return f"{len(errors)} | {100 * np.median(errors):.1f} | {100 * max(errors):.1f}"


def _oracle(groups: dict[str, list[Graded]]) -> str:
    parts = []
    for name, graded in groups.items():
        ratios = summary.oracle_ratios(graded)
        if ratios:
            parts.append(f"{name} {np.median(ratios):.3f} ({min(ratios):.3f}), {len(ratios)} cases")
    head = "## Gain on an unseen flight, relative to the true structure\n\n"
    return f"{head}Median (worst): {'; '.join(parts)}.\n"


def _misses(graded: Sequence[Graded]) -> str:
    wrong = [g for g in graded if not right(g)]
    listed = "\n".join(f"* {_told(g)}" for g in wrong)
    return f"## Wrong answers ({len(wrong)})\n\n{listed}\n"


def _told(g: Graded) -> str:
    """A wrong answer in words; the sizes of what was hidden follow from its class and number."""
    hidden = ", ".join(g.case.hidden or g.case.outside)
    said = ", ".join(g.listed) or g.note or "nothing"
    return (
        f"{g.case.group} {g.case.number}, {g.case.vehicle}: hidden {hidden}; {g.verdict}: {said}; error "
        f"{g.mse_nominal:.3g} → {g.mse_extended:.3g}"
    )


def confusion(singles: Sequence[Graded], path: Path) -> None:
    """Draws hidden effect against first finding."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    hidden = list(EFFECTS)
    named = [*EFFECTS, "unknown", "nothing_found"]
    counts = np.zeros((len(hidden), len(named)))
    for g in singles:
        own = [e for e in g.case.expected if e != "rotor_drag"] or list(g.case.expected)
        said = own[0] if g.first in g.case.expected else (g.first if g.named else g.verdict)
        counts[hidden.index(own[0]), named.index(said if said in named else "unknown")] += 1
    figure, axes = plt.subplots(figsize=(11, 9.5), layout="constrained")
    axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(counts.max(), 1))
    for i, j in np.argwhere(counts > 0):
        colour = "white" if counts[i, j] > 0.6 * counts.max() else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(named)), named, rotation=90, fontsize=8)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=8)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def detection(sizes: dict[float, list[Graded]], path: Path) -> None:
    """Draws the share found and the share of wrong names against the size of the effect."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    scales = sorted(s for s in sizes if sizes[s])
    found = [np.mean([set(g.case.expected) <= set(g.named) for g in sizes[s]]) for s in scales]
    wrong = [np.mean([any(n not in g.case.hidden for n in g.named) for g in sizes[s]]) for s in scales]
    axes.semilogx(scales, found, "o-", label="found and named")
    axes.semilogx(scales, wrong, "s--", label="something else named")
    axes.set_xticks(scales, [f"{s:g}" for s in scales])
    axes.set_xlabel("size of the effect, realistic size = 1")
    axes.set_ylabel("share of cases")
    axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
