"""A short version of `quadid reproduce`: relations that must hold between the columns, and the files it writes."""

import math
from pathlib import Path
from typing import Any

import pytest
from matplotlib import rc_context
from quadid_evaluation.paper.page import PAPER_GAIN, PAPER_MSE
from quadid_evaluation.paper.protocol import Plan, reproduce

from quadid.cli.demo import write
from quadid.jsonable import jsonable
from quadid.parameters import NOMINAL_NAMES


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("reproduced")
    plan = Plan(seconds=40.0, particles=32, iterations=12, seeds=1)
    found, scores = reproduce(folder / "flights", plan, 1, lambda stage, share: None, "a test")
    result = jsonable(found)
    with rc_context({"text.usetex": True}):  # as a matplotlibrc in the working folder has it
        return {**result, "files": write(result, scores, folder)}, folder


def test_the_searches_stand_in_their_order(done: tuple[dict[str, Any], Path]) -> None:
    train = {name: values[0] for name, values in done[0]["mse_paper"].items()}
    assert train["pso_polish"] <= train["quasi_newton"] * 1.001
    assert train["quasi_newton"] <= train["pso"] * 1.001
    assert train["pso"] < train["initial"]
    # No six numbers are better than the fitted ones, not even the true ones.
    assert train["pso_polish"] <= train["true_nominal"]


def test_fits_of_the_nominal_model_stop_above_the_floor_and_the_extended_model_reaches_it(
    done: tuple[dict[str, Any], Path],
) -> None:
    paper, mse = done[0]["mse_paper"], done[0]["mse"]
    for i in range(3):
        assert paper["pso_polish"][i] > 3.0 * paper["perfect"][i]
        assert paper["extended"][i] < 1.1 * paper["perfect"][i]
        assert mse["identified"][i] > 5.0
        assert mse["extended"][i] == pytest.approx(1.0, abs=0.1)
        for method in ("cva", "moesp"):
            assert mse["extended"][i] < mse[method][i] < mse["identified"][i]


def test_intervals_of_the_extended_model_cover(done: tuple[dict[str, Any], Path]) -> None:
    inside = 0
    for name in NOMINAL_NAMES:
        p = done[0]["parameters"][name]
        low, high = p["extended_ci95"]
        inside += low <= p["truth"] <= high
        # within twice the interval: 95 % of intervals hold the truth, not all
        assert abs(p["extended"] - p["truth"]) < high - low
    assert inside >= 4
    flown = done[0]["flight"]["effects"]
    for finding in done[0]["findings"]:
        assert finding["effect"] in flown
    assert {f["effect"] for f in done[0]["findings"]} >= {"motor_lag", "cg_offset", "rotor_drag"}


def test_one_seed_one_answer_and_everything_is_finite(done: tuple[dict[str, Any], Path]) -> None:
    assert done[0]["seed"] == 1
    for scores in (done[0]["mse"], done[0]["mse_paper"]):
        assert all(math.isfinite(v) for values in scores.values() for v in values)


def test_page_and_figures_are_written(done: tuple[dict[str, Any], Path]) -> None:
    result, folder = done
    text = (folder / "paper.md").read_text(encoding="utf-8")
    for printed in (*PAPER_MSE["quasi_newton"], *PAPER_MSE["pso"]):
        assert f"{printed:g}" in text
    for number in range(3, 9):
        assert f"paper/figure-{number}.png" in text
        assert (folder / "paper" / f"figure-{number}.png").read_bytes().startswith(b"\x89PNG")
        assert (folder / "paper" / f"figure-{number}.pdf").read_bytes().startswith(b"%PDF")
    assert result["date"] in text
    page = (folder / "paper.html").read_text(encoding="utf-8")
    assert "Table 1" in page
    assert "figure-8" in page
    for path in result["files"]:
        assert Path(path).is_file()


def test_the_papers_numbers_are_consistent_with_its_gains() -> None:
    """The gains printed in the paper's Table 1 follow from its errors, but for two slips of its own in rounding."""
    for name, gains in PAPER_GAIN.items():
        for i, gain in enumerate(gains):
            assert 1.0 - PAPER_MSE["pso"][i] / PAPER_MSE[name][i] == pytest.approx(gain, abs=2e-3)
