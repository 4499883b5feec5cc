"""`quadid identify` from logs to JSON, vehicle file and report: logs and columns it takes, and what later fits use."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from quadid_replay import write_csv, write_mcap

import quadid
import quadid.checks
from quadid.app.diagnose import Diagnosed
from quadid.app.excite import grouped
from quadid.app.identify import Identified
from quadid.app.init import init
from quadid.app.logs import Log, check_unseen
from quadid.checks.motion import Spans, flying_spans
from quadid.data.window import Recording
from quadid.errors import LogError, QuadidError
from quadid.flight import draw_outside, fly
from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS, Status
from quadid.report.verdict import reason
from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, Run, one_line

# --- `quadid identify` from logs to JSON, vehicle file and report


@pytest.fixture(scope="module")
def done(quadid: Cli, flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, dict[str, Any], Path]:
    """One identification with everything written: the run, its JSON, its folder."""
    out = tmp_path_factory.mktemp("identify")
    run = quadid(
        "identify", flights.train, "--validate", flights.unseen, "--vehicle", "pelican", "--out", "made", "--json",
        "result.json", "--report", "report.html", cwd=out,
    )  # fmt: skip
    return run, json.loads((out / "result.json").read_text(encoding="utf-8")), out


def test_json_has_exactly_the_keys_of_the_contract(done: tuple[Run, dict[str, Any], Path]) -> None:
    run, result, out = done
    assert run.code == 0, run.err
    keys = ["schema", "vehicle", "optimizer", "seed", "seconds", "parameters", "sets", "vehicle_file", "warnings"]
    assert list(result) == [*keys, "missing", "verdict", "report"]
    assert (result["schema"], result["vehicle"], result["optimizer"]) == ("quadid.identify/1", "pelican", "pso_polish")
    assert 0.0 < result["seconds"] < 300.0
    for p in result["parameters"]:
        assert list(p) == ["name", "unit", "value", "ci95", "initial", "status", "prior_share", "measured_before"]
        assert p["unit"] == NOMINAL_UNITS[p["name"]]
    assert [s["role"] for s in result["sets"]] == ["train", "validate"]
    assert [s["log"] for s in result["sets"]] == ["train.mcap", "unseen.csv"]
    for s in result["sets"]:
        assert list(s) == ["log", "role", "mse", "mse_paper", "fit_percent", "rmse", "seconds"]
        assert list(s["mse"]) == ["initial", "fitted", "noise_floor"]
        # the log holds references, so the stabiliser's gains are found and the paper's simulation can be run
        assert 0.0 < s["mse_paper"]["fitted"] < s["mse_paper"]["initial"]
        assert list(s["rmse"]["p"]) == ["value", "unit"]
    assert list(result["sets"][0]["fit_percent"])[:9] == ["p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z"]
    assert Path(result["report"]) == (out / "report.html").resolve()


def test_the_truth_is_found(done: tuple[Run, dict[str, Any], Path], flights: Flights) -> None:
    truth = flights.train_flight.truth.parameters.as_dict()
    for p in done[1]["parameters"]:
        assert p["status"] == "identified"
        # ci95 holds 1.96 sigma; 3.5 sigma are left for bad luck.
        reach = 3.5 / 1.96 * 0.5 * (p["ci95"][1] - p["ci95"][0])
        assert abs(p["value"] - truth[p["name"]]) < reach, p
        assert reach / p["value"] < 0.15


def test_scores_reach_the_noise_floor_on_both_logs(done: tuple[Run, dict[str, Any], Path]) -> None:
    for s in done[1]["sets"]:
        assert 0.85 < s["mse"]["fitted"] < 1.15
        assert s["mse"]["initial"] > 5.0
        assert min(s["fit_percent"][n] for n in ("p", "q", "r", "phi", "theta", "psi")) > 85.0
        assert s["rmse"]["p"] == {"value": pytest.approx(0.02, rel=0.2), "unit": "rad/s"}


def test_vehicle_file_holds_the_fit_and_can_be_used(
    done: tuple[Run, dict[str, Any], Path], inside: Cli, flights: Flights
) -> None:
    _, result, out = done
    path = Path(result["vehicle_file"])
    assert path.is_absolute()
    assert path == (out / "made" / "pelican.fitted.yaml").resolve()
    text = path.read_text(encoding="utf-8")
    assert re.search(r"# +train\.mcap +sha256 [0-9a-f]{64}", text)
    fitted = Vehicle.from_yaml(text)
    for p in result["parameters"]:
        prior = fitted.parameters[p["name"]]
        assert prior.initial == pytest.approx(p["value"], rel=1e-6)
        assert prior.sigma is not None
        assert math.log(p["ci95"][1] / p["value"]) == pytest.approx(1.96 * prior.sigma / prior.initial, rel=1e-3)
    assert fitted.parameters["b"].bounds == Vehicle.shipped("pelican").parameters["b"].bounds
    before = inside("score", flights.unseen, "--vehicle", "pelican", "--json", "-").data
    after = inside("score", flights.unseen, "--vehicle", path, "--json", "-").data
    assert after["horizons"]["50"]["rate"] < 0.3 * before["horizons"]["50"]["rate"]


def test_people_get_tables_with_units_and_no_control_characters(done: tuple[Run, dict[str, Any], Path]) -> None:
    run = done[0]
    assert "\x1b" not in run.out + run.err
    assert "\r" not in run.err
    assert " % " not in run.err, "no progress into a pipe"
    for expected in (
        "N s^2/rad^2",
        "kg m^2",
        "95 % interval",
        "train.mcap",
        "All 6 parameters identified",
        "Vehicle file: /",
    ):
        assert expected in run.out


def test_report_is_one_file_that_asks_for_nothing(done: tuple[Run, dict[str, Any], Path]) -> None:
    page = (done[2] / "report.html").read_bytes()
    assert len(page) < 6_000_000
    text = page.decode("utf-8")
    body = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    assert not re.search(r"""(src|href|action)\s*=\s*["']?(https?:)?//""", body)
    assert "default-src 'none'" in body
    for expected in (
        "All 6 parameters identified",
        "sha256",
        "quadid identify",
        "seed",
        "train.mcap",
        "unseen.csv",
        "What to fly next",
        "Cramér–Rao",
    ):
        assert expected in body


def test_same_seed_same_answer_and_stdout_is_json_alone(
    done: tuple[Run, dict[str, Any], Path], quadid: Cli, flights: Flights, tmp_path: Path
) -> None:
    run = quadid("identify", flights.train, "--vehicle", "pelican", "--out", tmp_path, "--json", "-")
    assert run.code == 0
    assert run.data["parameters"] == done[1]["parameters"]
    assert "report" not in run.data


def test_nothing_but_the_guess_is_exit_3_and_still_written(inside: Cli, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 600
    names = ["t", "p", "q", "r", "w1", "w2", "w3", "w4"]
    rows = np.column_stack([0.02 * np.arange(n), 0.02 * rng.standard_normal((n, 3)), np.full((n, 4), 400.0)])
    log = write_table(tmp_path / "still.csv", names, rows)
    run = inside("identify", log, "--vehicle", "pelican", "--out", tmp_path, "--json", tmp_path / "r.json")
    assert run.code == 3
    assert "reveal no parameter" in run.err
    assert "Traceback" not in run.err
    result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert {p["status"] for p in result["parameters"]} == {"prior_dominated"}
    assert Path(result["vehicle_file"]).is_file()


def test_a_span_of_a_log(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    log = f"{flights.train}@5:20"
    run = inside(
        "identify", log, "--vehicle", "pelican", "--out", tmp_path, "--json", "-", "--optimizer", "least_squares"
    )
    assert run.code == 0
    assert run.data["optimizer"] == "least_squares"
    assert [p["name"] for p in run.data["parameters"]] == list(NOMINAL_NAMES)
    bad = inside("identify", f"{flights.train}@50:60", "--vehicle", "pelican", "--out", tmp_path)
    assert bad.code == 2
    assert "nothing to use between" in bad.err


def test_no_velocity_needed_for_rates(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    names, rows = table(flights.unseen)
    keep = [names.index(n) for n in ("t", "p", "q", "r", "w1", "w2", "w3", "w4")]
    log = write_table(tmp_path / "gyro_only.csv", [names[i] for i in keep], rows[:, keep])
    result = inside("score", log, "--vehicle", "pelican", "--json", "-").data
    assert result["horizons"]["10"]["rate"] > 0.0
    assert result["horizons"]["10"] == {
        **result["horizons"]["10"],
        "position": None,
        "velocity": None,
        "rotation": None,
    }


def test_a_rotor_signal_too_slow_for_inertias_leaves_thrust_alone_to_be_fitted(
    inside: Cli, data_dir: Path, tmp_path: Path
) -> None:
    """Ten motor commands a second: thrust, but no inertia.

    Commands are no speeds: with a thrust curve, which this flight has, b is less than half as large.
    """
    vehicle = Path(__file__).parents[2] / "evaluation" / "quadid_evaluation" / "studies" / "vehicles" / "ascend.yaml"
    # A flight of a real PX4 without the setpoints of torque, from which its motors would be known at 50 Hz.
    whole = (data_dir / "px4" / "ascend_cubeorange_test.ulg").read_bytes()
    log = tmp_path / "slow.ulg"
    log.write_bytes(whole.replace(b"vehicle_torque_setpoint", b"vehicle_other_setpoints"))
    run = inside("identify", log, "--vehicle", vehicle, "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    status = {p["name"]: p["status"] for p in run.data["parameters"]}
    assert status.pop("b") == "unreliable"
    assert "b: more than 10% different when thrust_curve is in the model" in run.data["warnings"]
    assert set(status.values()) == {"prior_dominated"}
    for p in run.data["parameters"][1:]:
        assert p["value"] == p["initial"]
        assert p["ci95"][0] < 0.5 * p["value"]
    assert any("d, J_xx, J_yy, J_zz, J_r: the vehicle file's values are kept" in w for w in run.data["warnings"])
    assert "rotor signal at 10 Hz is too slow, 30 Hz needed" in run.err


def test_what_rests_on_a_bound_is_not_identified(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    pelican = Vehicle.shipped("pelican")
    narrow = {**pelican.parameters}
    value = 3.0 * flights.train_flight.truth.parameters.as_dict()["J_xx"]
    narrow["J_xx"] = narrow["J_xx"].model_copy(update={"initial": value, "bounds": (0.7 * value, 1.5 * value)})
    file = tmp_path / "narrow.yaml"
    file.write_text(pelican.model_copy(update={"parameters": narrow}).to_yaml(), encoding="utf-8")
    run = inside("identify", flights.train, "--vehicle", file, "--out", tmp_path, "--json", "-")
    by_name = {p["name"]: p for p in run.data["parameters"]}
    assert by_name["J_xx"]["status"] == "unreliable"
    assert any(w.startswith("J_xx = ") and "rests on its bound" in w for w in run.data["warnings"])


# --- `--columns` names the columns of a CSV wherever a log is read


COMMANDS = {"score": (), "replay": ("--diagnose", "0"), "excite": ("--seconds", "6.5"), "fleet": ("--workers", "1")}


@pytest.fixture(scope="module")
def renamed(flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a flight whose rates are called otherwise."""
    folder = tmp_path_factory.mktemp("logs")
    write_csv(folder / "a.csv", flights.train_flight.recording)
    head, rows = (folder / "a.csv").read_text(encoding="utf-8").split("\n", 1)
    names = [{"p": "gyro_x", "q": "gyro_y", "r": "gyro_z"}.get(name, name) for name in head.split(",")]
    (folder / "a.csv").write_text(",".join(names) + "\n" + rows, encoding="utf-8")
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_columns_are_named_wherever_a_log_is_read(command: str, renamed: Path, inside: Cli, tmp_path: Path) -> None:
    log = {"fleet": renamed, "excite": f"{renamed / 'a.csv'}@0:12"}.get(command, renamed / "a.csv")
    out = ("--out", tmp_path) if command in ("excite", "fleet") else ()
    call = (command, log, "--vehicle", "pelican", *COMMANDS[command], *out, "--json", "-")
    named = inside(*call, "--columns", "gyro_x=p,gyro_y=q,gyro_z=r")
    assert named.code in ((0, 3) if command == "replay" else (0,)), named.err  # a short flight publishes nothing yet
    if command == "fleet":
        assert named.data["counts"] == {"done": 1}
    elif command == "replay":
        assert named.data["status"] != inside(*call).data["status"]
    else:
        assert inside(*call).code == 2


def test_equal_movements_are_one_row() -> None:
    moves = [{"name": n, "amplitudes": {"roll": 0.1}} for n in ("a", "a", "b", "a")]
    assert [(name, times) for name, times, _ in grouped(moves)] == [("a", "2"), ("b", "1"), ("a", "1")]


# --- A flight that was fitted cannot validate: under another name, in another format, in part, from a second recorder


def load(path: Path | str) -> Log:
    return quadid.load(path, vehicle="pelican")


def moved(recording: Recording, by: float, noise: float = 0.0) -> Recording:
    """The recording at another time [s], as another gyro with noise of its own [rad/s] has it."""
    channels = {n: replace(c, t=c.t + by) for n, c in recording.channels.items()}
    rates = channels["gyro"].values
    extra = noise * np.random.default_rng(1).standard_normal(rates.shape)
    channels["gyro"] = replace(channels["gyro"], values=rates + extra)
    return replace(recording, channels=channels)


@pytest.mark.parametrize("spans", [("", ""), ("@0:20", "@15:30"), ("", "@5:15"), ("@10:20", "")])
def test_the_same_log_and_overlapping_parts_of_it(
    spans: tuple[str, str], inside: Cli, flights: Flights, tmp_path: Path
) -> None:
    copy = tmp_path / "renamed.mcap"
    shutil.copy(flights.train, copy)
    train, held = f"{flights.train}{spans[0]}", f"{copy}{spans[1]}"
    for command in ("identify", "diagnose", "compare"):
        line = one_line(inside(command, train, "--validate", held, "--vehicle", "pelican", "--out", tmp_path), 2)
        assert "renamed.mcap cannot validate" in line
        assert "train.mcap, which is fitted" in line


def test_a_copy_in_another_format(flights: Flights, tmp_path: Path) -> None:
    write_csv(tmp_path / "copy.csv", flights.train_flight.recording)
    with pytest.raises(LogError, match="cannot validate"):
        check_unseen([load(flights.train)], [load(tmp_path / "copy.csv")])


def test_another_flight_and_another_part_are_fine(flights: Flights) -> None:
    check_unseen([load(flights.train)], [load(flights.unseen)])
    check_unseen([load(f"{flights.train}@0:15")], [load(f"{flights.train}@15:30")])


def test_a_second_recorder_of_the_same_flight(flights: Flights, tmp_path: Path) -> None:
    for name, by, noise in (("one", 0.0, 0.0), ("two", 5.003, 0.02), ("later", 60.0, 0.02)):
        recording = moved(flights.train_flight.recording, by, noise)
        # The second recorder's clock starts five seconds earlier.
        epoch = 1_700_000_000 - (5 if name == "two" else 0)
        write_mcap(tmp_path / f"{name}.mcap", recording, epoch_ns=epoch * 10**9)
    with pytest.raises(LogError, match="cannot validate"):
        check_unseen([load(tmp_path / "one.mcap")], [load(tmp_path / "two.mcap")])
    check_unseen([load(tmp_path / "one.mcap")], [load(tmp_path / "later.mcap")])


# --- A red fit teaches the next one nothing: its values are guesses, and no export takes them unasked


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


def test_a_diagnosis_that_leaves_what_has_no_name_identifies_nothing(tmp_path: Path) -> None:
    """Its verdict was red, and values stood below it as identified."""
    flight = fly(Vehicle.shipped("pelican"), seconds=24.0, seed=5, outside={"gusts": draw_outside("gusts", 5)})
    write_csv(tmp_path / "gusts.csv", flight.recording)
    found = quadid.diagnose(tmp_path / "gusts.csv", vehicle="pelican")
    assert (found.verdict.level, found.result["verdict"]) == ("poor", "unknown")
    told = {p["name"]: p["status"] for p in found.result["parameters"]}
    assert told == {p.name: p.status for p in found.found.parameters}
    assert set(told.values()) <= {"unreliable", "prior_dominated"}
    # Its file guesses as the former one does.
    former = Vehicle.shipped("pelican").parameters
    assert found.vehicle.parameters == {n: p.model_copy(update={"sigma": None}) for n, p in former.items()}


def test_what_a_flight_does_not_show_keeps_its_guess(tmp_path: Path) -> None:
    """J_r was answered as 6.7e-5 for a guess of 3e-5, beside the words that the guess is kept."""
    fit = quadid.identify(
        quadid.simulate(seconds=40, seed=1, profile="gentle").save(tmp_path / "a.csv"), vehicle="pelican"
    )
    hidden = [p for p in fit.result["parameters"] if p["status"] == "prior_dominated"]
    assert "J_r" in [p["name"] for p in hidden]
    for p in hidden:
        assert p["value"] == p["initial"] == fit.vehicle.parameters[p["name"]].initial
        assert p["ci95"][0] < p["value"] < p["ci95"][1]
        assert "the file keeps its guess" in reason(p)


class Flown(NamedTuple):
    """Two flights of a Pelican as it is, the fit of the first alone, and its file."""

    one: Path
    other: Path
    alone: Identified
    fitted: Path


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("again")
    one, other = (quadid.simulate(seconds=25, seed=seed).save(folder / f"{seed}.csv") for seed in (5, 6))
    alone = quadid.identify(quadid.load(one, vehicle="pelican"))
    return Flown(one, other, alone, alone.vehicle.save(folder / "fitted.yaml"))


def test_only_an_unseen_flight_makes_it_green(flown: Flown) -> None:
    one, other, early = (quadid.load(log, vehicle="pelican") for log in (flown.one, flown.other, f"{flown.other}@0:5"))
    alone, proven, short = flown.alone, quadid.identify(one, validate=other), quadid.identify(one, validate=early)
    assert [fit.verdict.level for fit in (alone, short, proven)] == ["fair", "fair", "good"]
    assert "--validate" in alone.verdict.next_steps[0]
    assert alone.vehicle.proof is not None
    assert alone.vehicle.proof.lacking
    assert proven.vehicle.proof is not None
    assert not proven.vehicle.proof.lacking


def test_a_flight_is_not_counted_twice(flown: Flown, tmp_path: Path) -> None:
    """Nor a part of it under another name."""
    copy, fitted = f"{shutil.copy(flown.one, tmp_path / 'copy.csv')}@5:20", flown.fitted
    again = quadid.identify(quadid.load(copy, vehicle=fitted))
    assert any("copy.csv (5.csv) already" in warning for warning in again.warnings)
    # What the flight says alone, from the same start: nothing is sharper for having been fitted before.
    bare = Vehicle.from_yaml(fitted.read_text(encoding="utf-8")).model_copy(update={"proof": None})
    guesses = {n: p.model_copy(update={"sigma": None}) for n, p in bare.parameters.items()}
    alone = quadid.identify(quadid.load(copy, vehicle=bare.model_copy(update={"parameters": guesses})))
    assert again.parameters.values.tolist() == alone.parameters.values.tolist()
    assert [p["ci95"] for p in again.result["parameters"]] == [p["ci95"] for p in alone.result["parameters"]]
    assert all(p.status is Status.IDENTIFIED for p in again.parameters if p.name in ("b", "J_xx", "J_yy"))


def test_a_prior_that_decides_is_named(flown: Flown) -> None:
    _, other, _, fitted = flown
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


def test_a_file_is_not_proven_on_its_own_flight(flown: Flown) -> None:
    one, other, _, fitted = flown
    with pytest.raises(LogError, match="to which this vehicle file was fitted"):
        quadid.identify(quadid.load(other, vehicle=fitted), validate=quadid.load(one, vehicle=fitted))
    scored = quadid.score(quadid.load(one, vehicle=fitted))
    assert any("no proof" in warning for warning in scored.warnings)
    assert not quadid.score(quadid.load(other, vehicle=fitted)).warnings


# --- A log that also stands on the ground: what is in the air is used, and named as LOG@from:to


@pytest.fixture(scope="module")
def standing(flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that begins with ten seconds on its legs, rotors idling."""
    names, rows = table(flights.unseen)
    early = rows[:, 0] < rows[0, 0] + 10.0
    still = {
        "p": 0.0,
        "q": 0.0,
        "r": 0.0,
        "ax": 0.0,
        "ay": 0.0,
        "az": -9.81,
        "qw": 1.0,
        "qx": 0.0,
        "qy": 0.0,
        "qz": 0.0,
    }
    for name, value in {**still, **{n: 80.0 for n in names if n.startswith("w")}}.items():
        rows[early, names.index(name)] = value
    noise = np.random.default_rng(1).normal(0.0, 0.01, (len(rows), 6))
    rows[:, [names.index(n) for n in ("p", "q", "r", "ax", "ay", "az")]] += noise
    return write_table(tmp_path_factory.mktemp("standing") / "standing.csv", names, rows)


def test_inspect_proposes_what_is_in_the_air(inside: Cli, standing: Path) -> None:
    run = inside("inspect", standing, "--vehicle", "pelican", "--json", "-")
    assert run.data["use"] == ["standing.csv@12:30"]
    assert "use standing.csv@12:30" in inside("inspect", standing, "--vehicle", "pelican").err
    assert inside("inspect", f"{standing}@12:30", "--json", "-").data["use"] == []


def test_excitation_is_that_of_the_flight(inside: Cli, standing: Path) -> None:
    whole, cut, all_of_it = (
        inside("inspect", f"{standing}{part}", "--vehicle", "pelican", "--json", "-").data["excitation"]
        for part in ("", "@12:30", "@0:")
    )
    assert whole == cut
    assert whole != all_of_it


def test_when_it_flies_is_worked_out_once(standing: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def counted(recording: Recording, vehicle: Vehicle | None) -> Spans:
        asked.append(recording.name)
        return flying_spans(recording, vehicle)

    monkeypatch.setattr(quadid.checks, "flying_spans", counted)
    quadid.load(standing, vehicle="pelican")
    assert len(asked) == 1


def test_only_what_is_in_the_air_is_used_and_said_once(standing: Path) -> None:
    log = quadid.load(standing, vehicle="pelican")
    assert [w for w in log.warnings if "ground" in w] == [
        "standing.csv: time on the ground is left out: fits use standing.csv@12:30; to use all of it: standing.csv@0:"
    ]
    (flown,) = log.windows
    (cut,) = quadid.load(f"{standing}@12:30", vehicle="pelican").windows
    np.testing.assert_array_equal(flown.gyro, cut.gyro)
    (slower,) = log.at(25.0).windows
    assert slower.t[0] >= log.recording.channels["gyro"].t[0] + 12.0 - 1e-6


@pytest.mark.parametrize("part", ["@0:", "@12:30"])
def test_a_part_that_was_asked_for_is_used_as_it_is(standing: Path, part: str) -> None:
    log = quadid.load(f"{standing}{part}", vehicle="pelican")
    assert not [w for w in log.warnings if "ground" in w]
    first = log.recording.channels["gyro"].t[0]
    assert log.windows[0].t[0] - first == pytest.approx(float(part[1:].split(":")[0]), abs=0.02)


def test_a_part_with_ground_in_it_is_used_and_said(standing: Path) -> None:
    log = quadid.load(f"{standing}@5:30", vehicle="pelican")
    said = "standing.csv: this part also stands on the ground, which carries the vehicle: use standing.csv@12:30"
    assert [w for w in log.warnings if "ground" in w] == [said]
    assert [w for w in quadid.inspect(f"{standing}@5:30", vehicle="pelican").warnings if "ground" in w] == [said[14:]]


def test_no_number_is_identified_where_something_else_carries_the_weight(standing: Path) -> None:
    """Feet carried the vehicle for a third of this span; b, and J with b / J, are a compromise."""
    found = quadid.identify(f"{standing}@0:", vehicle="pelican")
    assert {p.status.value for p in found.parameters} <= {"unreliable", "prior_dominated"}
    assert found.verdict.level == "poor"
    assert any("so far from this flight" in text for text in found.fit.warnings)


def test_a_refused_log_proposes_it_as_well(standing: Path, tmp_path: Path) -> None:
    names, rows = table(standing)
    rows[:, names.index("az")] *= -1.0
    wrong = write_table(tmp_path / "wrong.csv", names, rows)
    with pytest.raises(LogError) as refused:
        quadid.load(wrong, vehicle="pelican")
    assert "use wrong.csv@12:30" in str(refused.value.fix)


def test_a_recorded_flight(inside: Cli, data_dir: Path) -> None:
    """Armed at 72 s, crashed at about 220 s: see the data's README."""
    (use,) = inside("inspect", data_dir / "ardupilot" / "log171.bin", "--json", "-").data["use"]
    start, stop = (float(v) for v in use.rpartition("@")[2].split(":"))
    assert 72.0 < start < 78.0
    assert 210.0 < stop < 230.0


# --- When there is no answer, the report still says why and shows the data


@pytest.mark.parametrize("command", ["identify", "diagnose"])
def test_wrong_units_are_refused_and_shown(inside: Cli, flights: Flights, tmp_path: Path, command: str) -> None:
    names, rows = table(flights.unseen)
    for c in (names.index(n) for n in ("p", "q", "r")):
        rows[:, c] = np.rad2deg(rows[:, c])
    log = write_table(tmp_path / "degrees.csv", names, rows)
    report = tmp_path / "why.html"
    run = inside(command, log, "--vehicle", "pelican", "--out", tmp_path, "--report", report)
    line = one_line(run, 2)
    assert f"the data as they are: {report}" in run.err
    page = report.read_text(encoding="utf-8")
    assert "No answer: degrees.csv:" in page
    assert "Nothing was identified" in page
    for shown in ("rotor speed", "gyro", "sha256", "What degrees.csv allows"):
        assert shown in page
    assert line.split(": ")[1] in page


def test_logs_that_cannot_be_read_are_named(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    (tmp_path / "empty.bin").write_bytes(b"")
    report = tmp_path / "why.html"
    run = inside(
        "identify", flights.train, tmp_path / "empty.bin", "--vehicle", "pelican", "--report", report, "--out", tmp_path
    )
    one_line(run, 2)
    page = report.read_text(encoding="utf-8")
    assert "empty.bin" in page
    assert "train.mcap" in page


# --- One flight, one error: what `identify` states for it is what `diagnose` starts from


def test_on_an_unseen_flight(tmp_path: Path) -> None:
    """Two flights with rotor drag and a weak rotor, as in the tutorial."""
    hidden = ("rotor_drag:k_x=0.3,k_y=0.3", "weak_rotor:rotor=2,loss=0.04")
    paths = [quadid.simulate(seconds=40, seed=s, effects=hidden).save(tmp_path / f"{s}.mcap") for s in (3, 4)]
    train, unseen = (quadid.load(path, vehicle="pelican") for path in paths)
    fit, found = quadid.identify(train, validate=unseen), quadid.diagnose(train, validate=unseen)
    assert_alike(fit, found)
    stated = found.result["validation"]
    assert stated["mse_nominal"] > 10.0
    assert stated["mse_extended"] == pytest.approx(1.0, abs=0.1)
    assert stated["deciding"]["seconds"] == found.result["findings"][0]["gain"]["seconds"] != 1.0
    assert f"falls from {stated['mse_nominal']:.3g} to" in found.verdict.details[1]
    assert f"In simulations of {stated['deciding']['seconds']:g} s" in found.verdict.details[2]


def test_no_value_is_identified_where_the_model_is_wrong_about_its_errors_on_another_flight(tmp_path: Path) -> None:
    """Fitted to a flight without a payload that the other one drops: the first model expects no such errors."""
    paths = [
        quadid.simulate(seconds=40, seed=s, effects=e).save(tmp_path / f"{s}.mcap")
        for s, e in ((5, ()), (6, ("mass_change:time=20,fraction=-0.2",)))
    ]
    beside = quadid.identify(*paths, vehicle="pelican")
    assert beside.verdict.level == "poor"
    assert beside.verdict.headline.startswith("Not to be used yet")
    assert {p["status"] for p in beside.result["parameters"]} == {"unreliable"}
    assert all(p.sigma is None for p in beside.vehicle.parameters.values())


def test_on_motion_capture_and_blocks_left_out(data_dir: Path) -> None:
    """Noise of two millimetres, and a model that misses slow moments: it is right about its errors, and the same."""
    folder = data_dir / "crazyflie_rpm"
    log = quadid.load(f"{folder / 'figure8_27.csv'}@0:25", vehicle=folder / "vehicle.yaml")
    fit, found = quadid.identify(log), quadid.diagnose(log)
    assert_alike(fit, found)
    assert any("random forces" in warning for warning in fit.warnings)
    assert found.result["validation"]["on"] == "held-out blocks"
    assert "held-out blocks of the same flight" in found.verdict.details[1]
    assert any("no unseen flight" in line for line in found.verdict.details)
    assert found.file_name != fit.file_name, "one command never writes over the other's file"
    # What the model lacks is no noise: a Crazyflie's gyro is quieter than 0.15 rad/s.
    assert np.all(np.sqrt(fit.fit.noise.variance[:3]) < 0.15)


def assert_alike(fit: Identified, found: Diagnosed) -> None:
    """Every log has one error without the findings, and misses one force and moment, in both results."""
    assert fit.result["missing"]["force"]["nominal"] == found.result["missing"]["force"]["nominal"]
    assert fit.result["missing"]["moment"]["nominal"] == found.result["missing"]["moment"]["nominal"]
    assert all(0.85 < s["mse"]["fitted"] < 1.3 for s in fit.result["sets"])
    assert [s["mse"]["fitted"] for s in fit.result["sets"]] == [s["mse"]["nominal"] for s in found.result["sets"]]
    assert [s["log"] for s in fit.result["sets"]] == [s["log"] for s in found.result["sets"]]


# --- `quadid init`, `quadid vehicles`, and logs whose columns have other names


def test_a_template_is_a_vehicle_and_says_what_to_fill_in(inside: Cli, tmp_path: Path) -> None:
    run = inside("init", "my quad", "--mass", "0.9", "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    vehicle = Vehicle.from_yaml(Path(run.data["file"]).read_text(encoding="utf-8"))
    assert (vehicle.name, vehicle.mass) == ("my quad", 0.9)
    assert run.data["fill_in"] == ["rotors"]
    refused = one_line(inside("identify", "any.csv", "--vehicle", run.data["file"]), 2)
    assert "rotors is a guess of `quadid init`" in refused
    assert "is there already" in one_line(inside("init", "my quad", "--out", tmp_path), 2)


def test_a_log_of_an_autopilot_fills_it(inside: Cli, data_dir: Path, tmp_path: Path) -> None:
    log = data_dir / "px4" / "ascend_cubeorange_test.ulg"
    run = inside("init", "copter", "--from", log, "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    text = Path(run.data["file"]).read_text(encoding="utf-8")
    assert text == init("copter", log).content
    assert len(Vehicle.from_yaml(text).rotors) >= 4
    assert "mass" in run.data["fill_in"]


def test_a_log_without_an_airframe_is_refused(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    assert "airframe" in one_line(inside("init", "x", "--from", flights.train, "--out", tmp_path), 2)


def test_shipped_vehicles(inside: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = inside("vehicles", "--json", "-").data["vehicles"]
    assert {"pelican", "hexacopter", "crazyflie_brushless"} <= {row["name"] for row in rows}
    for width in (60, 80):
        monkeypatch.setenv("COLUMNS", str(width))
        assert max(map(len, inside("vehicles").out.splitlines())) <= width


def test_columns_of_other_names(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    header, _, rows = flights.unseen.read_text(encoding="utf-8").partition("\n")
    renamed = {"t": "time_s", "p": "gyro_x", "q": "gyro_y", "r": "gyro_z"}
    log = tmp_path / "named.csv"
    log.write_text(",".join(renamed.get(n, n) for n in header.split(",")) + "\n" + rows, encoding="utf-8")
    options = ["--columns", "time_s=t,gyro_x=p", "--columns", "gyro_y=q,gyro_z=r"]
    expected = inside("score", flights.unseen, "--vehicle", "pelican", "--json", "-").data
    assert (
        inside("score", log, "--vehicle", "pelican", *options, "--json", "-").data["horizons"] == expected["horizons"]
    )
    file = Vehicle.shipped("pelican").model_copy(update={"columns": renamed}).save(tmp_path / "mine.yaml")
    assert quadid.score(quadid.load(log, vehicle=file)).result["horizons"] == expected["horizons"]
    for wrong, why in (
        ("gyro_x", "NAME_IN_FILE=NAME"),
        ("gyrox=p,time_s=t", "gyro_x"),
        ("time_s=t,gyro_x=pp", "unknown"),
    ):
        assert why in one_line(inside("score", log, "--vehicle", "pelican", "--columns", wrong), 2)
