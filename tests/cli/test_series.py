"""`--series`: simulated against measured as files that public readers open, with the errors that the result states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.cli.conftest import Flights, table
from tests.commands import Cli, one_line

RATES = "pqr"


@pytest.fixture(scope="module")
def result(quadid: Cli, flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("series")
    run = quadid(
        "identify", flights.train, "--validate", flights.unseen, "--vehicle", "pelican", "--out", folder,
        "--series", folder / "over" / "time", "--json", "-",
    )  # fmt: skip
    assert run.code == 0, run.err
    return dict(run.data)


def test_one_file_a_log_and_form(result: dict[str, Any]) -> None:
    names = [f"{log}.simulated.{kind}" for log in ("train.mcap", "unseen.csv") for kind in ("csv", "mcap")]
    missing = ["train.mcap.missing.csv", "unseen.csv.missing.csv"]
    assert [Path(path).name for path in result["series"]] == [*names, *missing]


def test_what_is_missing_stands_in_newtons_with_its_bands(result: dict[str, Any]) -> None:
    """Of exact flights nearly nothing is missing; the file over time says what the result says of them."""
    missing = result["missing"]
    assert [s["role"] for s in missing["sets"]] == ["train", "validate"]
    assert missing["force"]["of"] == pytest.approx(1.3 * 9.80665)
    assert (missing["force"]["unit"], missing["moment"]["of_what"]) == ("N", "rms control moment")
    for axis in "xyz":
        assert missing["force"]["nominal"][axis] < 0.01 * missing["force"]["of"]
        assert missing["moment"]["nominal"][axis] < 0.1 * missing["moment"]["of"][axis]
        low, high = missing["moment"]["nominal_ci95"][axis]
        assert low <= missing["moment"]["nominal"][axis] <= high
    names, rows = table(Path(result["series"][-2]))
    force, sigma = (rows[:, names.index(f"nominal/{name}_x")] for name in ("force", "force_sigma"))
    stated = missing["sets"][0]["force"]["nominal"]["x"]
    assert np.sqrt(np.mean(force**2 + sigma**2)) == pytest.approx(stated, rel=1e-4)


def test_the_csv_holds_the_stated_errors(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][0]))
    assert names[:4] == ["t", "measured/p", "measured/q", "measured/r"]
    assert {"simulated/phi", "before/az"} <= set(names)
    for rate in RATES:
        measured, simulated = (rows[:, names.index(f"{which}/{rate}")] for which in ("measured", "simulated"))
        stated = result["sets"][0]["rmse"][rate]["value"]
        assert np.sqrt(np.nanmean((simulated - measured) ** 2)) == pytest.approx(stated, rel=1e-6)


def test_the_mcap_holds_the_same_in_the_frames_of_ros(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][0]))
    pitch: dict[str, list[float]] = {which: [] for which in ("measured", "simulated", "before")}
    with Path(result["series"][1]).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        stamps, topics, force = [], set(), []
        for _, channel, message, decoded in reader.iter_decoded_messages():
            stamps.append(message.log_time)
            which, _, topic = channel.topic.partition("/")
            topics.add(channel.topic)
            if topic == "imu":
                pitch[which].append(decoded.angular_velocity.y)
            if channel.topic == "missing/nominal":
                force.append(decoded.wrench.force.z)
    assert stamps == sorted(stamps)
    for which, values in pitch.items():
        np.testing.assert_allclose(values, -rows[:, names.index(f"{which}/q")], rtol=1e-12)
    assert {"innovation/nominal/imu", "missing/nominal", "missing/nominal/sigma"} <= topics
    names, rows = table(Path(result["series"][-2]))
    np.testing.assert_allclose(force, -rows[:, names.index("nominal/force_z")], rtol=1e-6, atol=1e-12)


def test_innovations_of_an_exact_model_are_white_and_as_large_as_stated(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][-1]))
    for rate in RATES:
        found, sigma = (rows[:, names.index(f"nominal/{name}_{rate}")] for name in ("innovation", "innovation_sigma"))
        whitened = found / sigma
        assert np.nanmean(whitened**2) == pytest.approx(1.0, abs=0.1)
        assert abs(np.nanmean(whitened[1:] * whitened[:-1])) < 0.08


def test_a_file_where_the_folder_should_be_is_refused_before_anything_is_read(inside: Cli, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    line = one_line(inside("diagnose", "none.mcap", "--vehicle", "pelican", "--series", tmp_path / "taken"), 2)
    assert "taken" in line
