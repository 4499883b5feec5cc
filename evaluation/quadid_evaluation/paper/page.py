"""The page of `quadid reproduce`: as Markdown, and as what `quadid.report.page.render` shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from quadid.report.page import section
from quadid.report.verdict import effects_words
from quadid.types import Json
from quadid_evaluation.paper.figures import FIGURES
from quadid_evaluation.paper.tables import all_tables, markdown

TITLE = "The paper, reproduced"
SHOWN = ("Table", "What the nominal model lacks")
"""Tables of the Markdown page; the others are in the report and in the JSON."""
SOURCE = (
    "Abanou & Mansour, *Precision Parameter Identification in Quadcopter UAV Systems Using Particle Swarm Algorithm*"
)


def notes(result: Json) -> dict[str, list[str]]:
    """Sentences for each table, by its title."""
    said = {
        "Table 1": _about_table_1(result),
        "Remaining error": _about_the_rest(result),
        "Prediction": _about_prediction(result),
        "Table 2": _about_parameters(result),
    }
    return {t.title: next((v for k, v in said.items() if t.title.startswith(k)), []) for t in all_tables(result)}


def _about_table_1(result: Json) -> list[str]:
    mse = result["mse_paper"]
    swarm = mse["pso"][0] / mse["quasi_newton"][0] - 1.0
    return [
        "MSE, Eq. (13): mean squared error over φ θ ψ [deg], p q r [deg/s] and gravity-corrected a_x a_y a_z [m/s²] "
        "of the whole set, simulated in closed loop from references and throttle. The flights are ours, and the paper "
        "prints neither units nor weights of its nine outputs: compare ratios, not values.",
        f"Here the swarm (median of {result['swarm']['seeds']} seeds, {result['swarm']['particles']} particles, "
        f"{result['swarm']['iterations']} iterations) ends {abs(swarm):.1%} {'above' if swarm >= 0.0 else 'below'} "
        "quasi-Newton on the training set. Both minimise the same smooth function, so neither can gain 16 to 24 % over "
        "the other once both have converged; the paper's quasi-Newton run probably had not. Convergence rates: "
        "[optimisers.md](optimisers.md).",
    ]


def _about_the_rest(result: Json) -> list[str]:
    mse = result["mse_paper"]
    return [
        "*True parameters*: the nominal model with the true values; its error on set 1 is "
        f"{mse['true_nominal'][0] / mse['quasi_newton'][0]:.2f} times that of quasi-Newton, so the rest is model "
        "error. *Flown vehicle*: the model with all flown effects; its error is sensor noise and the stabiliser's "
        f"response. The extended model leaves {mse['extended'][1] / mse['quasi_newton'][1]:.0%} of quasi-Newton's "
        "error on set 2.",
    ]


def _about_prediction(result: Json) -> list[str]:
    orders, mse = result["orders"], result["mse"]
    return [
        f"Prediction over 1 s on set 2 (1 = noise floor): quasi-Newton {mse['quasi_newton'][1]:.4g}, quadid nominal "
        f"{mse['identified'][1]:.4g}, extended {mse['extended'][1]:.4g}; black boxes of {orders['cva']} states: CVA "
        f"{mse['cva'][1]:.4g}, MOESP {mse['moesp'][1]:.4g}.",
    ]


def _about_parameters(result: Json) -> list[str]:
    rows = result["parameters"].values()
    inside, wrong = (sum(p[key][0] <= p["truth"] <= p[key][1] for p in rows) for key in ("extended_ci95", "ci95"))
    return [
        f"The 95 % intervals of the extended model contain {inside} of 6 true values, those of the nominal model "
        f"{wrong}, widened by differences between parts of the flight. d and J_zz are correlated by "
        f"{result['correlations'][1][4]:+.2f} in the nominal model.",
    ]


def paper_markdown(result: Json, figures: str) -> str:
    """The page as Markdown.

    Args:
        result: of the form ``quadid.reproduce/1``.
        figures: folder of the pictures, relative to the page.
    """
    flight, said = result["flight"], notes(result)
    lines = [
        f"# {TITLE}", "", f"{SOURCE}.", "",
        f"`{result['command']}`, {result['date']}, seed {result['seed']}, {result['seconds']:.0f} s; quadid "
        f"{result['version']}. `make reproduce` renews this page.", "",
        f"Three sets of {flight['seconds']:g} s of a simulated Pelican, stabiliser at {flight['stabiliser_rate']:g} "
        "Hz, logged at 50 Hz; set 1 trains, sets 2 and 3 validate. The vehicle flies with effects that the paper's "
        f"model lacks: {effects_words(flight['effects'])}. The stabiliser's gains are given.",
        "",
    ]  # fmt: skip
    for table in all_tables(result):
        lines += [f"## {table.title}", "", markdown(table), ""] if table.title.startswith(SHOWN) else []
        for sentence in said[table.title]:
            lines += [sentence, ""]
    lines += [f"Verdict of the diagnosis: {result['verdict']}.", "", "## Figures 3 to 8", ""]
    lines += ["Blue: measurement. Dashed red: quasi-Newton. Yellow: PSO. The most excited 20 s of each set.", ""]
    for figure in FIGURES:
        lines += [f"![{figure.title}]({figures}/figure-{figure.number}.png)", ""]
    return "\n".join(lines).rstrip() + "\n"


def paper_sections(result: Json, figures: Sequence[Json]) -> dict[str, Any]:
    """The page for `render`: tables, then interactive figures."""
    said = notes(result)
    sections = [
        section(f"table-{i}", t.title, " ".join(said[t.title]).replace("*", ""), tables=[t.part()])
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
