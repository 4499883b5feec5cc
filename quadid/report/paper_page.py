"""The page of `quadid reproduce`: as Markdown, and as what `quadid.report.page.render` shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadid.report.paper_figures import FIGURES
from quadid.report.paper_tables import all_tables, markdown
from quadid.report.parts import rows_of, section
from quadid.report.words import effects_words

JsonDict = Mapping[str, Any]

TITLE = "The paper, reproduced"
SOURCE = (
    "Abanou & Mansour, *Precision Parameter Identification in Quadcopter UAV Systems Using Particle Swarm Algorithm*"
)


def notes(result: JsonDict) -> dict[str, list[str]]:
    """Sentences for each table, by its title."""
    said = {
        "Table 1": _about_table_1(result),
        "What is left": _about_the_rest(result),
        "Prediction": _about_prediction(result),
        "Table 2": _about_parameters(result),
    }
    return {t.title: next((v for k, v in said.items() if t.title.startswith(k)), []) for t in all_tables(result)}


def _about_table_1(result: JsonDict) -> list[str]:
    mse = result["mse_paper"]
    swarm = mse["pso"][0] / mse["quasi_newton"][0] - 1.0
    return [
        "MSE, Eq. (13): mean squared error over φ θ ψ [deg], p q r [deg/s] and gravity-corrected a_x a_y a_z [m/s²] "
        "of the whole set, simulated from references and throttle with the stabiliser in the loop. The flights are "
        "ours and the paper prints neither units nor weights of its nine outputs: compare ratios, not numbers.",
        f"Here the swarm (median of {result['swarm']['seeds']} seeds, {result['swarm']['particles']} particles, "
        f"{result['swarm']['iterations']} iterations) ends {abs(swarm):.1%} {'above' if swarm >= 0.0 else 'below'} "
        "quasi-Newton on the training set. Both minimise the same smooth function from the same guess, so neither can "
        "gain 16 to 24 % over the other once both have converged; the figures suggest that the paper's quasi-Newton "
        "run had not. How often each method converges: [optimisers.md](optimisers.md).",
    ]


def _about_the_rest(result: JsonDict) -> list[str]:
    mse = result["mse_paper"]
    return [
        "*True six numbers*: the nominal model with the vehicle's true values; its error on set 1 is "
        f"{mse['true_nominal'][0] / mse['quasi_newton'][0]:.2f} times that of quasi-Newton, so what is left is the "
        "model's error. *The flown vehicle*: the model with everything that was flown; what it leaves is sensor noise "
        "and the stabiliser's answer to it. The extended model leaves "
        f"{mse['extended'][1] / mse['quasi_newton'][1]:.0%} of quasi-Newton's error on set 2.",
    ]


def _about_prediction(result: JsonDict) -> list[str]:
    orders = result["orders"]
    return [
        "Initial states are estimated, errors are over those of a perfect model. CVA and MOESP are black boxes of "
        f"{orders['cva']} and {orders['moesp']} states, without physical parameters.",
    ]


def _about_parameters(result: JsonDict) -> list[str]:
    rows = result["parameters"].values()
    inside, wrong = (sum(p[key][0] <= p["truth"] <= p[key][1] for p in rows) for key in ("extended_ci95", "ci95"))
    return [
        f"Of the six 95 % intervals of the extended model {inside} hold the truth, of those of the nominal model "
        f"{wrong}: what parts of the flight make of a number widens them where an effect is missing. d and J_zz, and "
        "J_r with them, are told apart only by small terms, as their correlations show.",
    ]


def paper_markdown(result: JsonDict, figures: str) -> str:
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
        "Hz, logged at 50 Hz; set 1 trains, sets 2 and 3 validate and are seen by no fit. The vehicle flies with "
        f"effects that the paper's model lacks: {effects_words(flight['effects'])}. The stabiliser's gains are given.",
        "",
    ]  # fmt: skip
    for table in all_tables(result):
        lines += [f"## {table.title}", "", markdown(table), ""]
        for sentence in said[table.title]:
            lines += [sentence, ""]
    lines += [f"Verdict of the diagnosis: {result['verdict']}.", "", "## Figures 3 to 8", ""]
    lines += ["Blue: measurement. Dashed red: quasi-Newton. Yellow: PSO. The liveliest 20 s of each set.", ""]
    for figure in FIGURES:
        lines += [f"![{figure.title}]({figures}/figure-{figure.number}.png)", ""]
    return "\n".join(lines).rstrip() + "\n"


def paper_sections(result: JsonDict, figures: Sequence[JsonDict]) -> dict[str, Any]:
    """The page for `render`: tables, then interactive figures."""
    said = notes(result)
    sections = [
        section(f"table-{i}", t.title, " ".join(said[t.title]).replace("*", ""), tables=[rows_of(t.head, t.rows)])
        for i, t in enumerate(all_tables(result))
    ]
    intro = "The liveliest 20 s of each set; the paper's figures in the same order."
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
