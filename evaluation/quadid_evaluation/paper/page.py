"""The page of `quadid reproduce`: Tables 1 and 2 in the paper's form, beside its numbers, and the tables it lacks.

As Markdown, and as what `quadid.report.page.render` shows.
"""

import math
from collections.abc import Sequence
from typing import Any

from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS
from quadid.report.page import section
from quadid.report.tables import Column, TextTable
from quadid.report.verdict import effects_words
from quadid.types import Json
from quadid_evaluation.harness import table as markdown
from quadid_evaluation.paper.figures import FIGURES

TITLE = "The paper, reproduced"
SHOWN = ("Table", "What the nominal model lacks")
"""Tables of the Markdown page; the others are in the report and in the JSON."""
SOURCE = (
    "Abanou & Mansour, *Precision Parameter Identification in Quadcopter UAV Systems Using Particle Swarm Algorithm*"
)
PAPER_MSE: dict[str, tuple[float, float, float]] = {
    "initial": (14.64, 16.81, 18.93),
    "quasi_newton": (7.67, 8.79, 8.71),
    "pso": (6.388, 6.694, 7.309),
}
"""Table 1 of the paper: MSE of sets 1, 2, 3."""
PAPER_GAIN: dict[str, tuple[float, float, float]] = {
    "initial": (0.5637, 0.6018, 0.6139),
    "quasi_newton": (0.1672, 0.2384, 0.1608),
}
"""Its gains of PSO over the others, as printed."""
PAPER_PARAMETERS: dict[str, float] = {
    "b": 2.33e-5,
    "d": 4.96e-7,
    "J_xx": 1.00e-2,
    "J_yy": 1.36e-2,
    "J_zz": 2.92e-2,
    "J_r": 5.00e-5,
}
"""Table 2 of the paper."""
COLUMN_NAMES = {
    "initial": "initial guess",
    "quasi_newton": "quasi-Newton",
    "pso": "PSO",
    "pso_polish": "PSO + polish",
    "identified": "quadid, nominal",
    "extended": "quadid, extended",
    "true_nominal": "true parameters",
    "perfect": "flown vehicle",
    "cva": "CVA",
    "moesp": "MOESP",
}
"""Models by name, for people."""


def text(value: float | None) -> str:
    """A number with four digits, or a dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def interval(pair: Sequence[float]) -> str:
    """An interval."""
    return f"{text(pair[0])} … {text(pair[1])}"


def all_tables(result: Json) -> list[TextTable]:
    """Every table in the order of the page."""
    mse, parameters = result["mse_paper"], result["parameters"]
    sets = [f"set {i + 1} ({'training' if i == 0 else 'validation'})" for i in range(3)]

    def made(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> TextTable:
        return TextTable(title, tuple(Column(h, right=i > 0) for i, h in enumerate(head)), tuple(map(tuple, rows)))

    def by_set(title: str, scores: Json, names: Sequence[str]) -> TextTable:
        rows = [[one, *(text(scores[n][i]) for n in names)] for i, one in enumerate(sets)]
        return made(title, ["set", *(COLUMN_NAMES[n] for n in names)], rows)

    others = ("pso_polish", "identified")
    return [
        made(
            "Table 1: mean squared error of the closed-loop simulation",
            ["set (paper, here)", *(COLUMN_NAMES[n] for n in PAPER_MSE),
             *(f"gain over {COLUMN_NAMES[n]}" for n in PAPER_GAIN)],
            [
                [one, *(f"{text(printed[i])}, {text(mse[name][i])}" for name, printed in PAPER_MSE.items()),
                 *(f"{100 * gains[i]:.2f} %, {100 * (1.0 - mse['pso'][i] / mse[name][i]):.2f} %"
                   for name, gains in PAPER_GAIN.items())]
                for i, one in enumerate(sets)
            ],
        ),
        by_set("Remaining error", mse, ("quasi_newton", "pso", *others, "true_nominal", "extended", "perfect")),
        by_set(
            "Prediction over 1 s (1 = noise floor)", result["mse"],
            ("initial", "quasi_newton", "pso", *others, "cva", "moesp", "extended", "perfect"),
        ),
        made(
            "Table 2: parameters",
            ["parameter", "unit", "paper", "true here", "initial", "quasi-Newton", "PSO: median (range) of seeds",
             "quadid, nominal [95 % interval], status", "quadid, extended [95 % interval]"],
            [
                [name, NOMINAL_UNITS[name], text(PAPER_PARAMETERS[name]), text(p["truth"]), text(p["initial"]),
                 text(p["quasi_newton"]),
                 f"{text(p['pso'])} ({interval((min(p['pso_seeds']), max(p['pso_seeds'])))})",
                 f"{text(p['identified'])} [{interval(p['ci95'])}], {p['status']}",
                 f"{text(p['extended'])} [{interval(p['extended_ci95'])}]"]
                for name, p in ((name, parameters[name]) for name in NOMINAL_NAMES)
            ],
        ),
        made(
            "What the nominal model lacks (error on sets 2 and 3, 1 = noise floor)",
            ["cause", "unit", "flown", "found", "95 % interval", "error without → with"],
            [
                [f"{finding['effect']}.{p['name']}", p["unit"],
                 text(result["flight"]["effects"].get(finding["effect"], {}).get(p["name"])), text(p["value"]),
                 interval(p["ci95"]), f"{text(finding['gain']['mse_before'])} → {text(finding['gain']['mse_after'])}"]
                for finding in result["findings"] for p in finding["parameters"]
            ],
        ),
        made(
            "Correlation of the estimates (nominal model, set 1)", ["", *NOMINAL_NAMES],
            [[name, *(f"{value:+.2f}" for value in row)]
             for name, row in zip(NOMINAL_NAMES, result["correlations"], strict=True)],
        ),
    ]  # fmt: skip


def notes(result: Json) -> dict[str, list[str]]:
    """Sentences for each table, by the beginning of its title."""
    paper, mse, orders, swarm = result["mse_paper"], result["mse"], result["orders"], result["swarm"]
    newton = paper["quasi_newton"]
    above = paper["pso"][0] / newton[0] - 1.0
    rows = result["parameters"].values()
    inside, wrong = (sum(p[key][0] <= p["truth"] <= p[key][1] for p in rows) for key in ("extended_ci95", "ci95"))
    exact, extended = paper["true_nominal"][0] / newton[0], paper["extended"][1] / newton[1]
    return {
        "Table 1": [
            "MSE, Eq. (13): mean squared error over φ θ ψ [deg], p q r [deg/s] and gravity-corrected a_x a_y a_z "
            "[m/s²] of the whole set, simulated in closed loop from references and throttle. The flights are ours, and "
            "the paper prints neither units nor weights of its nine outputs: compare ratios, not values.",
            f"Here the swarm (median of {swarm['seeds']} seeds, {swarm['particles']} particles, {swarm['iterations']} "
            f"iterations) ends {abs(above):.1%} {'above' if above >= 0.0 else 'below'} quasi-Newton on the training "
            "set. Both minimise the same smooth function, so neither can gain 16 to 24 % over the other once both have "
            "converged; the paper's quasi-Newton run probably had not. Convergence rates: "
            "[optimisers.md](optimisers.md).",
        ],
        "Remaining error": [
            f"*True parameters*: the nominal model with the true values; its error on set 1 is {exact:.2f} times that "
            "of quasi-Newton, so the rest is model error. *Flown vehicle*: the model with all flown effects; its error "
            f"is sensor noise and the stabiliser's response. The extended model leaves {extended:.0%} of "
            "quasi-Newton's error on set 2."
        ],
        "Prediction": [
            f"Prediction over 1 s on set 2 (1 = noise floor): quasi-Newton {mse['quasi_newton'][1]:.4g}, quadid "
            f"nominal {mse['identified'][1]:.4g}, extended {mse['extended'][1]:.4g}; black boxes of {orders['cva']} "
            f"states: CVA {mse['cva'][1]:.4g}, MOESP {mse['moesp'][1]:.4g}."
        ],
        "Table 2": [
            f"The 95 % intervals of the extended model contain {inside} of 6 true values, those of the nominal model "
            f"{wrong}, widened by differences between parts of the flight. d and J_zz are correlated by "
            f"{result['correlations'][1][4]:+.2f} in the nominal model."
        ],
    }


def paper_markdown(result: Json, figures: str) -> str:
    """The page as Markdown.

    Args:
        result: of the form ``quadid.reproduce/1``.
        figures: folder of the pictures, relative to the page.
    """
    flight = result["flight"]
    lines = [
        f"# {TITLE}",
        "",
        f"{SOURCE}.",
        "",
        f"`{result['command']}`, {result['date']}, seed {result['seed']}, {result['seconds']:.0f} s; quadid "
        f"{result['version']}. `make reproduce` renews this page.",
        "",
        f"Three sets of {flight['seconds']:g} s of a simulated Pelican, stabiliser at {flight['stabiliser_rate']:g} "
        "Hz, logged at 50 Hz; set 1 trains, sets 2 and 3 validate. The vehicle flies with effects that the paper's "
        f"model lacks: {effects_words(flight['effects'])}. The stabiliser's gains are given.",
        "",
    ]
    for table in all_tables(result):
        if table.title.startswith(SHOWN):
            lines += [f"## {table.title}", "", *markdown([c.heading for c in table.columns], table.rows), ""]
        for sentence in _about(table, result):
            lines += [sentence, ""]
    lines += [f"Verdict of the diagnosis: {result['verdict']}.", "", "## Figures 3 to 8", ""]
    lines += ["Blue: measurement. Dashed red: quasi-Newton. Yellow: PSO. The most excited 20 s of each set.", ""]
    for figure in FIGURES:
        lines += [f"![{figure.title}]({figures}/figure-{figure.number}.png)", ""]
    return "\n".join(lines).rstrip() + "\n"


def _about(table: TextTable, result: Json) -> list[str]:
    return next((said for title, said in notes(result).items() if table.title.startswith(title)), [])


def paper_sections(result: Json, figures: Sequence[Json]) -> dict[str, Any]:
    """The page for `render`: tables, then interactive figures."""
    sections = [
        section(f"table-{i}", t.title, " ".join(_about(t, result)).replace("*", ""), tables=[t.part()])
        for i, t in enumerate(all_tables(result))
    ]
    intro = "The most excited 20 s of each set; the paper's figures in the same order."
    sections.append(section("figures", "Figures 3 to 8", intro, figures))
    return {
        "title": TITLE,
        "subtitle": f"{result['date']}, seed {result['seed']}, three flights of {result['flight']['seconds']:g} s",
        "sections": sections,
        "provenance": [
            {"name": "paper", "value": SOURCE.replace("*", "")},
            {"name": "command", "value": result["command"]},
            {"name": "quadid", "value": result["version"]},
            {"name": "flown with", "value": effects_words(result["flight"]["effects"])},
        ],
    }
