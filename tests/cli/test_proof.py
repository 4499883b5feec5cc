"""A red fit teaches the next one nothing: its values are guesses, and no export takes them unasked."""

from __future__ import annotations

from pathlib import Path

import pytest

import quadid
from quadid.errors import QuadidError
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


def test_a_red_fit_writes_guesses(logs: tuple[Path, Path], tmp_path: Path) -> None:
    train, unseen = (quadid.load(path, vehicle="pelican") for path in logs)
    fit = quadid.identify(train, validate=unseen)
    assert fit.verdict.level == fit.result["verdict"] == "poor"
    file = fit.vehicle.save(tmp_path / "red.yaml")
    again = Vehicle.from_yaml(file.read_text(encoding="utf-8"))
    assert all(p.sigma is None for p in again.parameters.values())
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
    assert any("has not seen" in line for line in found.verdict.details)
