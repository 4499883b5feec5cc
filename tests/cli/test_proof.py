"""A red fit teaches the next one nothing: its values are guesses, and no export takes them unasked."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import quadid
from quadid.errors import LogError, QuadidError
from quadid.parameters import Status
from quadid.vehicle import Vehicle


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two flights of a vehicle with a weak rotor and rotor drag."""
    folder = tmp_path_factory.mktemp("flown")
    effects = ["weak_rotor:rotor=2,loss=0.1", "motor_lag:tau=0.08"]
    one, other = (
        quadid.simulate(seconds=30, seed=seed, effects=effects).save(folder / f"{seed}.csv") for seed in (3, 4)
    )
    return one, other


def test_a_red_fit_writes_guesses(tmp_path: Path) -> None:
    """The unseen flight drops a payload, which the model of the other one does not expect."""
    train, unseen = (
        quadid.load(quadid.simulate(seconds=30, seed=s, effects=e).save(tmp_path / f"{s}.csv"), vehicle="pelican")
        for s, e in ((3, ()), (4, ("mass_change:time=15,fraction=-0.2",)))
    )
    fit = quadid.identify(train, validate=unseen)
    assert fit.verdict.level == fit.result["verdict"] == "poor"
    file = fit.vehicle.save(tmp_path / "red.yaml")
    again = Vehicle.from_yaml(file.read_text(encoding="utf-8"))
    assert all(p.sigma is None for p in again.parameters.values())
    # What is not identified is as the former file has it.
    former, doubtful = (
        Vehicle.shipped("pelican").parameters,
        {p.name for p in fit.parameters if p.status != "identified"},
    )
    assert doubtful
    assert {n: again.parameters[n] for n in doubtful} == {n: former[n] for n in doubtful}
    assert again.random is not None
    assert again.proof is not None
    assert again.proof.unseen == (unseen.name,)
    with pytest.raises(QuadidError, match="--anyway"):
        quadid.export(file, "px4")


def test_only_an_unseen_flight_makes_it_green(tmp_path: Path) -> None:
    paths = [quadid.simulate(seconds=25, seed=seed).save(tmp_path / f"{seed}.csv") for seed in (5, 6)]
    one, other = (quadid.load(path, vehicle="pelican") for path in paths)
    alone, proven = quadid.identify(one), quadid.identify(one, validate=other)
    short = quadid.identify(one, validate=quadid.load(f"{paths[1]}@0:5", vehicle="pelican"))
    assert [fit.verdict.level for fit in (alone, short, proven)] == ["fair", "fair", "good"]
    assert "--validate" in alone.verdict.next_steps[0]
    assert alone.vehicle.proof is not None
    assert alone.vehicle.proof.lacking
    assert proven.vehicle.proof is not None
    assert not proven.vehicle.proof.lacking
    found = quadid.diagnose(one)
    assert found.verdict.level == "fair"
    assert any("no unseen flight" in line for line in found.verdict.details)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Two flights of a Pelican as it is, and the file fitted to the first."""
    folder = tmp_path_factory.mktemp("again")
    one, other = (quadid.simulate(seconds=25, seed=seed).save(folder / f"{seed}.csv") for seed in (5, 6))
    return one, other, quadid.identify(quadid.load(one, vehicle="pelican")).vehicle.save(folder / "fitted.yaml")


@pytest.mark.parametrize("part", ["", "@5:20"])
def test_a_flight_is_not_counted_twice(flown: tuple[Path, Path, Path], part: str, tmp_path: Path) -> None:
    one, _, fitted = flown
    copy = shutil.copy(one, tmp_path / "copy.csv")
    again = quadid.identify(quadid.load(f"{copy}{part}", vehicle=fitted))
    assert any("copy.csv (5.csv) already" in warning for warning in again.warnings)
    # What the flight says alone, from the same start: nothing is sharper for having been fitted before.
    bare = Vehicle.from_yaml(fitted.read_text(encoding="utf-8")).model_copy(update={"proof": None})
    guesses = {n: p.model_copy(update={"sigma": None}) for n, p in bare.parameters.items()}
    alone = quadid.identify(quadid.load(f"{copy}{part}", vehicle=bare.model_copy(update={"parameters": guesses})))
    assert again.parameters.values.tolist() == alone.parameters.values.tolist()
    assert [p["ci95"] for p in again.result["parameters"]] == [p["ci95"] for p in alone.result["parameters"]]
    assert all(p.status is Status.IDENTIFIED for p in again.parameters if p.name in ("b", "J_xx", "J_yy"))


def test_a_prior_that_decides_is_named(flown: tuple[Path, Path, Path]) -> None:
    _, other, fitted = flown
    second = quadid.identify(quadid.load(f"{other}@0:12", vehicle=fitted))
    entry = {p["name"]: p for p in second.result["parameters"]}["b"]
    assert entry["status"] == "prior_dominated"
    assert entry["measured_before"]
    table = second.tables()[0].text(100)
    assert f"{100 * entry['prior_share']:.0f} % from the file" in table
    assert "does not show" not in second.text()
    # The next file rests on both flights and says so.
    assert second.vehicle.proof is not None
    assert [flight.log for flight in second.vehicle.proof.fitted] == ["6.csv", "5.csv"]
    # What this flight did not identify stays as the former file has it, and only that file knows how sure it was.
    former, written = Vehicle.from_yaml(fitted.read_text(encoding="utf-8")).parameters["b"], second.vehicle.parameters
    assert written["b"] == former.model_copy(update={"sigma": None})


def test_a_file_is_not_proven_on_its_own_flight(flown: tuple[Path, Path, Path]) -> None:
    one, other, fitted = flown
    with pytest.raises(LogError, match="to which this vehicle file was fitted"):
        quadid.identify(quadid.load(other, vehicle=fitted), validate=quadid.load(one, vehicle=fitted))
    scored = quadid.score(quadid.load(one, vehicle=fitted))
    assert any("no proof" in warning for warning in scored.warnings)
    assert not quadid.score(quadid.load(other, vehicle=fitted)).warnings
