"""The library: calls that no command makes, and what notebooks take from a result; commands are the same functions."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from quadid_evaluation.paper.compare import compare
from quadid_evaluation.studies.health.flights import hover
from quadid_replay import write_csv

import quadid
from quadid.app.excite import propose
from quadid.app.health import HealthOutcome
from quadid.app.identify import Identified
from quadid.app.init import init
from quadid.app.logs import settled
from quadid.condition import assess, flight_trim
from quadid.errors import QuadidError, VehicleError
from quadid.identification.predict import start_errors
from quadid.jsonable import jsonable
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights
from tests.commands import Cli

WRITTEN = ("vehicle_file", "report", "files", "file", "log", "manoeuvre_file")
"""Paths of files, which only a command writes."""


def same(result: dict[str, Any]) -> dict[str, Any]:
    """A result without written files and wall time, as JSON has it."""
    return {k: v for k, v in jsonable(result).items() if k not in (*WRITTEN, "seconds")}


@pytest.fixture(scope="module")
def logs(flights: Flights) -> dict[str, str]:
    """Paths of two logs and of none."""
    return {"good": str(flights.train), "other": str(flights.unseen), "absent": str(flights.train.parent / "no.csv")}


@pytest.fixture(scope="module")
def alone(logs: dict[str, str]) -> Identified:
    """A fit to one flight, called with its path."""
    return quadid.identify(logs["good"], vehicle="pelican")


@pytest.fixture(scope="module")
def proven(logs: dict[str, str]) -> Identified:
    """The same with another flight to validate."""
    return quadid.identify(load(logs["good"]), validate=load(logs["other"]))


def load(path: str, vehicle: str = "pelican") -> Any:
    """A log of the library."""
    return quadid.load(path, vehicle=vehicle)


PATHS: dict[str, Callable[..., Any]] = {
    "inspect": quadid.inspect,
    "identify": quadid.identify,
    "diagnose": quadid.diagnose,
    "score": quadid.score,
    "health": lambda path, **vehicle: quadid.health(path, baseline=f"{path}@0:15", **vehicle),
}
"""Functions about a log, called with its path."""


def test_a_path_stands_for_the_loaded_log(logs: dict[str, str], alone: Identified) -> None:
    assert same(alone.result) == same(quadid.identify(load(logs["good"])).result)
    assert same(quadid.score(logs["good"], vehicle="pelican").result) == same(quadid.score(load(logs["good"])).result)


@pytest.mark.parametrize("name", PATHS)
def test_paths_are_refused_alike(name: str, logs: dict[str, str]) -> None:
    with pytest.raises(QuadidError, match="no file .*no.csv"):
        PATHS[name](logs["absent"], vehicle="pelican")
    if name != "inspect":
        with pytest.raises(VehicleError, match=r"no vehicle for .*quadid\.load\(path, vehicle="):
            PATHS[name](logs["good"])


def test_what_a_notebook_needs(logs: dict[str, str], proven: Identified, tmp_path: Path) -> None:
    fit = proven
    assert "Thrust coefficient b" in repr(fit)
    assert "<table>" in fit._repr_html_()
    frame = fit.to_frame()
    assert list(frame["name"]) == ["b", "d", "J_xx", "J_yy", "J_zz", "J_r"]
    assert fit.plot().data[0].name == "measured"
    assert fit.to_json(tmp_path / "fit.json") == (tmp_path / "fit.json").read_text(encoding="utf-8")
    path = fit.vehicle.save(tmp_path / "mine.yaml")
    assert quadid.load(logs["other"], vehicle=path).vehicle.parameters["b"].initial == pytest.approx(
        fit.parameters["b"].value, rel=1e-6
    )


def test_drawn_vehicles_have_the_covariance_and_fly(alone: Identified) -> None:
    fit = alone
    thetas, floors = fit.sample(4000, seed=3)
    p = fit.parameters
    known = [i for i, name in enumerate(p.names) if name not in floors]
    spread = np.cov(np.log(thetas[:, known]).T)
    wanted = (p.covariance / np.outer(p.values, p.values))[np.ix_(known, known)]
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), np.sqrt(np.diag(wanted)), rtol=0.06)
    assert np.corrcoef(spread.ravel(), wanted.ravel())[0, 1] > 0.99
    batch = quadid.Simulator(fit.vehicle, thetas[:20])
    state = batch.start(dt=0.01)
    for _ in range(50):
        batch.advance(state, np.full(4, fit.vehicle.hover_speed()), 0.01)
    assert np.isfinite(state.position).all()
    assert np.unique(state.velocity[:, 2]).size == 20


def test_what_is_freed_fixed_and_stated_is_fitted_so_by_library_and_command(inside: Cli, tmp_path: Path) -> None:
    late = quadid.simulate(seconds=20.0, effects=["motor_lag:tau=0.04"]).save(tmp_path / "late.csv")
    fit = quadid.identify(
        late,
        vehicle="pelican",
        free=["motor_lag.tau"],
        effects={"motor_lag": {"tau": 0.02}},
        fix=["J_r"],
        bounds={"J_xx": (5e-3, 3e-2)},
        priors={"d": (5e-7, 1e-8)},
    )
    run = inside(
        "identify", late, "--vehicle", "pelican", "--effect", "motor_lag:tau=0.02", "--free", "motor_lag.tau",
        "--fix", "J_r", "--bounds", "J_xx=5e-3:3e-2", "--prior", "d=5e-7:1e-8", "--out", tmp_path, "--json", "-",
    )  # fmt: skip
    assert same(run.data) == same(fit.result)
    for typed in (["--bounds", "J_xx=5e-3"], ["--prior", "d"], ["--effect", "motor_lag:tau=fast"]):
        refused = inside("identify", late, "--vehicle", "pelican", *typed)
        assert refused.code == 2
        assert f"cannot read '{typed[1].rpartition(':')[2]}'" in refused.err
    assert fit.parameters.names == ("b", "d", "J_xx", "J_yy", "J_zz", "motor_lag.tau")
    low, high = fit.parameters["motor_lag.tau"].ci95
    assert low < 0.04 < high
    assert high - low < 0.004
    assert fit.vehicle.effects["motor_lag"]["tau"] == pytest.approx(fit.parameters["motor_lag.tau"].value, rel=1e-5)
    assert fit.vehicle.parameters["J_r"].initial == 3e-5
    assert fit.vehicle.parameters["J_r"].sigma is None
    assert fit.vehicle.parameters["J_xx"].bounds == (5e-3, 3e-2)
    assert fit.to_frame().loc["d", "low"] < 4.96e-7 < fit.to_frame().loc["d", "high"]
    frame = quadid.load(late, "pelican").to_frame()
    assert frame.index.name == "t"
    assert {"p", "ax", "qw", "w1"} <= set(frame)
    assert len(frame) == 1000


@pytest.mark.parametrize(
    ("stated", "found"),
    [
        ({"fix": ["J_z"]}, "did you mean 'J_zz'"),
        ({"fix": ["J_q"]}, "allowed: b, d, J_xx"),
        ({"free": ["motor_lag.tau"]}, "the vehicle has no motor_lag"),
        ({"free": ["motor_lg.tau"]}, "did you mean 'motor_lag.tau'"),
        ({"bounds": {"b": (3e-5, 4e-5)}}, "outside bounds"),
        ({"priors": {"J": (1.0, 0.1)}}, "unknown parameter 'J'"),
        ({"effects": {"motor_lag": {"tu": 1.0}}}, "did you mean 'tau'"),
        ({"fix": ["b", "d", "J_xx", "J_yy", "J_zz", "J_r"]}, "every parameter is fixed"),
        ({"fix": ["d"], "optimizer": "least_squares"}, "free or fix with least_squares"),
    ],
)
def test_what_cannot_be_stated_is_refused(stated: dict[str, Any], found: str, logs: dict[str, str]) -> None:
    with pytest.raises(QuadidError, match=re.escape(found)):
        quadid.identify(logs["good"], vehicle="pelican", **stated)


def test_a_file_name_is_a_file_and_a_folder_a_folder(tmp_path: Path) -> None:
    exported = quadid.export("pelican", "rotorpy")
    assert exported.save(tmp_path / "mine.py") == [tmp_path / "mine.py"]
    assert (tmp_path / "mine.py").is_file()
    assert exported.save(tmp_path)[0].parent == tmp_path
    two = quadid.export("pelican", "ardupilot")
    assert len(two.texts) == 2
    with pytest.raises(QuadidError, match="holds 2 files"):
        two.save(tmp_path / "mine.param")


def test_what_was_not_measured_is_never_drawn_without_width() -> None:
    from quadid.parameters import Parameter, ParameterSet, Status

    unknown = Parameter("J_r", "kg m^2", 3e-5, sigma=1e-9, status=Status.PRIOR_DOMINATED)
    known = Parameter("b", "N s^2/rad^2", 2e-5, sigma=2e-7, status=Status.IDENTIFIED)
    drawn, floors = ParameterSet((known, unknown), np.diag([2e-7**2, 1e-18])).sample(4000)
    assert list(floors) == ["J_r"]
    np.testing.assert_allclose(np.log(drawn).std(axis=0), [0.01, 0.1], rtol=0.05)


def test_the_module_lists_public_names_only() -> None:
    assert {"excite", "init", "identify", "Simulator"} <= set(dir(quadid))
    assert not [n for n in dir(quadid) if n.startswith("_") and n != "__version__"]


def test_the_import_is_cheap_and_reads_no_logs() -> None:
    text = (
        "import sys, quadid\n"
        "heavy = [m for m in ('numpy', 'numba', 'quadid_replay', 'plotly', 'pydantic') if m in sys.modules]\n"
        "assert not heavy, heavy\n"
        "for name in quadid.__all__: assert callable(getattr(quadid, name)), name\n"
        "import quadid.identification.fit, quadid.diagnosis.pipeline\n"
        "assert quadid.identification.fit.fit and callable(quadid.identify) and callable(quadid.diagnose)\n"
    )
    subprocess.run([sys.executable, "-c", text], check=True, timeout=900)


def test_a_fitted_file_knows_the_voltage_that_it_was_fitted_at(tmp_path: Path) -> None:
    made = quadid.simulate(seconds=20.0, extras=["battery"])
    log = quadid.load(made.save(tmp_path / "sagging.csv"), "pelican")
    volts = np.concatenate([np.ravel(w.battery) for w in log.windows if w.battery is not None])
    fit = quadid.identify(log)
    assert fit.vehicle.reference_voltage == pytest.approx(np.nanmean(volts), rel=1e-3)


def test_parts_of_a_log_warn_of_it_once(logs: dict[str, str], tmp_path: Path) -> None:
    log = tmp_path / "torn.csv"
    write_csv(log, load(logs["good"]).recording)
    lines = log.read_text(encoding="utf-8").splitlines()
    log.write_text("\n".join([*lines[:-1], lines[-1][:9], ""]), encoding="utf-8")
    given = settled(load(f"{log}@0:8"), load(f"{log}@8:16"), None)
    torn = [text for text in given.warnings if "torn.csv" in text]
    assert torn
    assert len(torn) == len(set(torn))


def test_a_healthy_flight_has_a_table_of_changes_without_rows() -> None:
    trims = [flight_trim(hover(Vehicle.shipped("pelican_x"), seed=k), Vehicle.shipped("pelican_x")) for k in range(7)]
    found = assess(trims[:1], trims[1:], Vehicle.shipped("pelican_x"))
    none = HealthOutcome({"changes": []}, found, Vehicle.shipped("pelican_x"), ())
    some = {
        "effect": "thrust_drop",
        "confident": True,
        "p_value": 0.1,
        "parameters": [{"name": "fraction", "unit": "", "value": 0.1, "ci95": None}],
    }
    one = HealthOutcome({"changes": [some]}, found, Vehicle.shipped("pelican_x"), ())
    assert len(none.to_frame()) == 0
    assert list(none.to_frame()) == list(one.to_frame())


@pytest.mark.parametrize(
    ("call", "found"),
    [
        (lambda _: propose(height=(-50.0, 5000.0)), "height -50:5000"),
        (lambda _: propose(height=(float("nan"), 40.0)), "height nan:40"),
        (lambda _: propose(seed=-1), "seed -1"),
        (lambda _: quadid.simulate(seconds=5.0, seed=-1), "seed -1"),
        (lambda _: quadid.simulate(seconds=5.0, noise=-1.0), "noise -1"),
        (lambda _: quadid.simulate(seconds=5.0, noise=float("nan")), "noise nan"),
        (lambda _: quadid.simulate(seconds=5.0, spread=-0.1), "spread -0.1"),
        (lambda _: quadid.simulate(seconds=5.0, manoeuvre="/"), "cannot read /"),
        (lambda log: quadid.identify(log, vehicle="pelican", seed=-1), "seed -1"),
        (lambda log: quadid.diagnose(log, vehicle="pelican", seed=cast(int, 1.5)), "seed 1.5"),
        (lambda log: quadid.score(log, vehicle="pelican", horizons=cast(list[int], [1.5])), "horizons [1.5]"),
        (lambda log: quadid.score(log, vehicle="pelican", horizons="1;10"), "--horizons 1;10"),
        (lambda log: compare(log, vehicle="pelican", seeds=0), "no seed"),
        (lambda log: compare(log, vehicle="pelican", budget=3), "budget 3"),
        (lambda _: init("mine", mass=-1.0), "mass -1"),
        (lambda _: init("mine", arm=0.0), "arm 0"),
    ],
)
def test_what_the_command_refuses_the_call_refuses_too(
    call: Callable[[str], Any], found: str, logs: dict[str, str]
) -> None:
    with pytest.raises(QuadidError) as refused:
        call(logs["good"])
    assert found in str(refused.value)
    assert refused.value.allowed


def test_a_printed_fit_says_what_its_values_rest_on(alone: Identified) -> None:
    assert "mass" in alone.opening[0].text
    assert str(alone).startswith(alone.opening[0].text)


def test_vehicles_are_drawn_by_the_names_that_were_fitted(tmp_path: Path) -> None:
    late = quadid.simulate(seconds=20.0, effects=["motor_lag:tau=0.04"]).save(tmp_path / "late.csv")
    fit = quadid.identify(
        late,
        vehicle="pelican",
        free=["motor_lag.tau"],
        fix=["J_r"],
        effects={"motor_lag": {"tau": 0.02}, "rotor_drag": {"k_x": 0.1, "k_y": 0.1}},
    )
    thetas, floors = fit.sample(2000)
    layout = Layout(fit.vehicle)
    drawn = {name: thetas[:, layout.entry(name).index] for name in (*fit.parameters.names, "J_r", "rotor_drag.k_x")}
    tau = fit.parameters["motor_lag.tau"]
    assert np.median(drawn["motor_lag.tau"]) == pytest.approx(tau.value, rel=0.01)
    assert drawn["motor_lag.tau"].std() == pytest.approx(tau.sigma, rel=0.1)
    assert np.ptp(drawn["J_r"]) == np.ptp(drawn["rotor_drag.k_x"]) == 0.0
    assert drawn["J_r"][0] == 3e-5
    assert {"J_r", "rotor_drag"} <= set(floors)
    assert "motor_lag" not in floors


def test_what_a_fit_leaves_is_a_table_and_arrays(logs: dict[str, str], proven: Identified, tmp_path: Path) -> None:
    xarray, fit = pytest.importorskip("xarray"), proven
    left = fit.residuals()
    frame, arrays = left.to_frame(), left.to_xarray()
    assert isinstance(arrays, xarray.Dataset)
    np.testing.assert_array_equal(frame["residual_q"], arrays.residual.sel(output="q"))
    np.testing.assert_allclose(frame["residual_p"], frame["measured_p"] - frame["simulated_p"])
    assert np.abs(frame["residual_psi"]).max() <= np.pi
    assert frame["residual_p"].std() == pytest.approx(frame["sigma_p"].iloc[0], rel=0.2)
    fit.save_series(tmp_path)
    missing = fit.missing(log=0).to_frame()
    file = np.genfromtxt(tmp_path / "train.mcap.missing.csv", delimiter=",", names=True, deletechars="")
    np.testing.assert_allclose(file["nominal/force_z"], missing["force_z"], rtol=1e-6, atol=1e-9)
    assert (missing["moment_sigma_x"] > 0.0).all()
    with pytest.raises(QuadidError, match="unknown model 'extended'"):
        fit.missing(model="extended")
    channels = load(logs["good"]).to_xarray()
    assert dict(channels.sizes) == {"t": len(channels.t), "axis": 3, "quaternion": 4, "rotor": 4}
    np.testing.assert_array_equal(channels.gyro.sel(axis="y"), load(logs["good"]).to_frame()["q"])


def test_a_score_holds_the_spread_of_its_runs(logs: dict[str, str]) -> None:
    made = quadid.score(load(logs["other"]), horizons=(1, 10))
    frame = made.to_frame()
    assert list(frame.index[:4]) == ["position.1", "velocity.1", "rotation.1", "rate.1"]
    rate = frame.loc["rate.10"]
    windows = made.logs[0].windows
    runs = np.concatenate([errors[:, 1, 3] for errors in start_errors(windows, made.logs[0].vehicle, [1, 10, 50])])
    low, high = np.quantile(runs, [0.05, 0.95], method="nearest")
    assert (rate["low"], rate["high"]) == (low, high)
    assert rate["low"] < rate["error"] < rate["high"]


def test_without_an_extra_package_the_call_says_how_to_get_it(
    logs: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(QuadidError, match=r"xarray is not installed; fix: pip install 'quadid\[notebook\]'"):
        load(logs["good"]).to_xarray()
