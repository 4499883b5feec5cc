"""`quadid replay` and `quadid history`, run as a user runs them."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import Store
from quadid_replay import write_mcap
from quadid_replay.mcap_file import McapFile

from quadid.model.layout import ThrustModel
from quadid.online.fusion import with_tangent
from quadid.online.records import OnlineSet, SetState
from quadid.vehicle import GRAVITY, Command, Mounting, Vehicle
from tests.commands import Cli
from tests.faults.evidence import Happened
from tests.node.test_history import left
from tests.online.driving import flight
from tests.online.test_gate import TRUE, online_set


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "flight.mcap"
    drop = (("mass_change", "time", 33.3), ("mass_change", "fraction", 0.15))
    write_mcap(path, flight(40.0, 5, "excited", drop).recording, epoch_ns=1_700_000_000 * 10**9)
    return path


def test_a_log_gives_sets_findings_and_an_mcap(log: Path, tmp_path: Path, quadid: Cli, inside: Cli) -> None:
    out = tmp_path / "published.mcap"
    result = quadid("replay", log, "--vehicle", "pelican", "--out", out, "--json", "-").data
    assert result["schema"] == "quadid.replay/1"
    assert [(s["state"], bool(s["outdated"])) for s in result["published"]] == [("accepted", False), ("accepted", True)]
    (diagnosis,) = result["diagnoses"]
    assert diagnosis["findings"][0]["effect"] == "mass_change"
    when = next(p["value"] for p in diagnosis["findings"][0]["parameters"] if p["name"] == "time")
    assert when + result["epoch"] == pytest.approx(1_700_000_033.3, abs=0.1)
    file = McapFile(out)
    names = {topic.name: topic.type for topic in file.topics.values()}
    assert names == {
        "quadid/parameters": "quadid_msgs/msg/ParameterSet",
        "quadid/candidate": "quadid_msgs/msg/ParameterSet",
        "quadid/diagnosis": "quadid_msgs/msg/Diagnosis",
        "quadid/health": "quadid_msgs/msg/Health",
    }
    # health says at once that it has no baseline; everything else rests on a whole window
    rest = {number for number, topic in file.topics.items() if topic.name != "quadid/health"}
    stamps = [ns for _, ns, _ in file.messages(rest)]
    assert min(stamps) >= 1_700_000_010 * 10**9
    again = inside("replay", str(log), "--vehicle", "pelican", "--json", "-")
    assert json.loads(again.out)["published"] == result["published"], "the same bits every time"


def test_a_span_of_a_log_is_played(log: Path, inside: Cli) -> None:
    done = inside("replay", f"{log}@2:6", "--vehicle", "pelican", "--diagnose", "0", "--json", "-")
    assert done.code == 3, "too short to publish anything, as the whole log does"
    assert json.loads(done.out)["published"] == []
    whole = inside("replay", f"{log}@2:6", "--vehicle", "pelican", "--as-recorded")
    assert whole.code == 2
    assert "a part; allowed: whole recordings" in whole.err


def test_nothing_published_is_exit_code_3_with_the_reason(tmp_path: Path, inside: Cli) -> None:
    path = tmp_path / "hover.mcap"
    write_mcap(path, flight(20.0, 7, "hover").recording)
    done = inside("replay", str(path), "--vehicle", "pelican")
    assert done.code == 3
    assert "move too little" in done.out


def test_what_is_wrong_with_the_log_is_said_beside_what_it_would_have_published(tmp_path: Path, inside: Cli) -> None:
    """The service waits for narrower intervals; that a rotor reads 1.3 times its speed was said by all but `replay`."""
    made = flight(20.0, 12).recording
    speeds = replace(made.channels["rotor_speed"], values=made.channels["rotor_speed"].values * [1.0, 1.3, 1.0, 1.0])
    write_mcap(tmp_path / "read.mcap", replace(made, channels={**made.channels, "rotor_speed": speeds}))
    done = inside("replay", str(tmp_path / "read.mcap"), "--vehicle", "pelican", "--diagnose", "0")
    assert "as if rotor 2 read 1.30 times its speed" in done.err


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--speed", "fast"), "speed"),
        (("--speed", "-1"), "speed"),
        (("--approval", "never"), "approval"),
        (("--window", "1"), "window"),
        (("--rate", "1e9"), "rate"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(log: Path, arguments: tuple[str, ...], word: str, inside: Cli) -> None:
    done = inside("replay", str(log), "--vehicle", "pelican", *arguments)
    assert done.code == 2
    assert word in done.err
    assert len(done.err.strip().splitlines()) == 1


def test_history_shows_what_was_stored(tmp_path: Path, inside: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=1, approved_by="ann", reason="three windows agree"))
    store.close(60.0)
    monkeypatch.setenv("QUADID_HISTORY", str(path))
    done = inside("history", "--vehicle", "pelican", "--json", "-")
    assert done.code == 0, done.err
    (entry,) = json.loads(done.out)["sets"]
    assert (entry["approved_by"], entry["reason"]) == ("ann", "three windows agree")
    shown = inside("history", "--vehicle", "pelican", "--history", str(path))
    assert "ann" in shown.out
    missing = inside("history", "--vehicle", "pelican", "--history", str(tmp_path / "none"))
    assert missing.code == 2
    assert "no history" in missing.err


def test_a_vehicle_of_a_fleet_is_found_by_its_name_and_its_set_exported(tmp_path: Path, inside: Cli) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "quad1")
    wide = online_set(TRUE).parameters.scaled_together(0.09)
    store.numbered(replace(online_set(TRUE), parameters=wide, reference_sd=0.09, sequence=1, approved_by="ann"))
    store.close(60.0)
    told = inside("history", "--vehicle", "quad1", "--history", str(path), "--json", "-")
    assert [s["sequence"] for s in json.loads(told.out)["sets"]] == [1]
    unknown = inside("history", "--vehicle", "quad7", "--history", str(path))
    assert unknown.code == 2
    assert "quad1" in unknown.err
    where = ("--vehicle", "pelican", "--history", str(path), "--out", str(tmp_path))
    done = inside("export", *where, "--id", "quad1", "--json", "-")
    assert done.code == 0, done.err
    (file,) = json.loads(done.out)["files"]
    exported = Vehicle.from_yaml(Path(file).read_text(encoding="utf-8"))
    assert exported.parameters["b"].initial == pytest.approx(TRUE["b"], rel=1e-6)
    assert exported.parameters["b"].sigma == pytest.approx(0.09 * TRUE["b"], rel=0.01)
    assert exported.correlation["J_xx"]["b"] > 0.99, "one factor on all, or a later gate compares nothing with the file"
    assert "set 1 of quad1" in Path(file).read_text(encoding="utf-8")
    other = inside("export", *where)
    assert other.code == 2
    assert "one of: quad1" in other.err
    assert "--history" in inside("export", "--vehicle", "pelican", "--id", "quad1").err


def history_of(path: Path, *items: OnlineSet) -> Path:
    store = Store(path, "pelican")
    for number, item in enumerate(items, 1):
        store.numbered(replace(item, sequence=number, approved_by=item.approved_by or "auto"))
    store.close(60.0)
    return path


GOOD = replace(online_set(TRUE), mass=1.3)
MAD = replace(online_set({**TRUE, "b": 1e3}), mass=1.3)
DOUBTFUL = {
    "withdrawn": ((GOOD, replace(GOOD, outdated="thrust stepped by -17.9 %")), "out of date: thrust stepped"),
    "withdrawn by a stale row": (
        (GOOD, replace(GOOD, state=SetState.STALE, outdated="thrust stepped")),
        "out of date: thrust stepped",
    ),
    "not confirmed since a restart": ((GOOD, replace(GOOD, state=SetState.STALE)), "stale: no flight has confirmed it"),
    "of another mass": ((replace(GOOD, mass=1.35),), "a mass of 1.35 kg, the vehicle file has 1.3 kg"),
    "of a mass not stated": ((replace(GOOD, mass=math.nan),), "a mass that it does not state"),
    "rolled back to and withdrawn": (
        (GOOD, *(replace(GOOD, state=SetState.ROLLED_BACK, outdated=why) for why in ("", "stepped"))),
        "out of date: stepped",
    ),
    "withdrawn, and another waits": (
        (GOOD, replace(GOOD, outdated="stepped"), replace(GOOD, state=SetState.PENDING)),
        "out of date: stepped",
    ),
    "of a mass that is none": ((replace(GOOD, mass=130.0),), "a mass of 130 kg, the vehicle has 1.3 kg"),
    "no plausible one": ((GOOD, MAD), "no set that a fit makes"),
}


@pytest.mark.parametrize("case", list(DOUBTFUL))
def test_a_set_that_is_not_in_force_is_exported_only_when_insisted(
    case: str, tmp_path: Path, inside: Cli, happened: Happened
) -> None:
    items, why = DOUBTFUL[case]
    path = history_of(tmp_path / "h.sqlite", *items)
    out = tmp_path / "out"
    where = ("--vehicle", "pelican", "--history", str(path), "--out", str(out))
    refused = inside("export", *where)
    assert refused.code == 2
    assert why in refused.err
    assert "--anyway" in refused.err
    assert not list(out.glob("*"))
    done = inside("export", *where, "--anyway", "--json", "-")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert why in told["warnings"][-1]
    first = Path(told["files"][0]).read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("# NOT PROVEN: ")
    assert why in first
    for command in (
        ("export", "--format", "px4"),
        ("gains", "--format", "px4"),
    ):  # what was written is no less in doubt
        again = inside(*command, "--vehicle", told["files"][0], "--out", out)
        assert again.code == 2
        assert why in again.err
    shown = inside("history", "--vehicle", "pelican", "--history", str(path), "--json", "-")
    assert why in json.loads(shown.out)["in_force"]["doubt"]
    # The service takes up none of these as it is: one rule for all who read a history.
    item = left(path, Vehicle.shipped("pelican")).item
    assert item is None or item.outdated or case == "not confirmed since a restart"
    happened(36, f"export of a set {case}: '{refused.err.strip()[:100]}'")


@pytest.mark.parametrize("b", [-2.33e-5, 0.0, 1e40])
def test_a_value_that_no_vehicle_file_holds_is_refused_in_one_line(
    b: float, tmp_path: Path, inside: Cli, happened: Happened
) -> None:
    path = history_of(tmp_path / "h.sqlite", replace(online_set({**TRUE, "b": b}), mass=1.3))
    run = inside("export", "--vehicle", "pelican", "--history", path, "--out", tmp_path / "out", "--anyway")
    assert run.code == 2
    assert "no set that a fit makes" in run.err
    assert len(run.err.strip().splitlines()) == 1
    happened(36, f"export of b = {b:g}: refused")


PWM = Command(kind="pwm", max_speed=900.0)
OTHERS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "rotors": ({}, {"rotors": Vehicle.shipped("pelican_x").rotors}),
    "command": ({"command": PWM}, {"command": PWM.model_copy(update={"max_speed": 1000.0})}),
    "effects": ({"effects": {"motor_lag": {"tau": 0.03}}}, {"effects": {"thrust_curve": {"dead_speed": 60.0}}}),
    "mounting": ({}, {"mounting": Mounting(rotation=(0.0, 0.0, 0.1))}),
    "": ({}, {"command": Command(max_speed=900.0)}),  # scales no reading
}
"""Part of the vehicle file that b and the inertias rest on: when a set was made, and now."""


@pytest.mark.parametrize("other", list(OTHERS))
def test_a_set_that_rests_on_another_vehicle_file_is_exported_only_when_insisted(
    other: str, tmp_path: Path, inside: Cli, happened: Happened
) -> None:
    """Of the same name and mass; the service that finds such a set publishes it as out of date."""
    path, file = tmp_path / "h.sqlite", tmp_path / "mine.yaml"
    before, now = (Vehicle.shipped("pelican").model_copy(update=update) for update in OTHERS[other])
    store = Store(path, "pelican")
    store.restore(vehicle=before)
    store.numbered(replace(GOOD, sequence=1, approved_by="auto"))
    store.close(60.0)
    for vehicle in (before, now):
        vehicle.save(file)
        why = f"{other} than the vehicle file has now" if vehicle is now and other else ""
        run = inside("export", "--vehicle", file, "--history", path, "--out", tmp_path / "out")
        assert run.code == (2 if why else 0), run.err
        assert why in run.err
        item = left(path, Vehicle.named(file)).item
        assert item is not None
        assert bool(item.outdated) == bool(why)
        assert why in item.outdated
    happened(36, f"export of a set, the vehicle file has other {other or 'max_speed'}: code {run.code}")


def test_a_set_in_force_is_exported_without_a_word(tmp_path: Path, inside: Cli) -> None:
    path = history_of(tmp_path / "h.sqlite", replace(GOOD, outdated="thrust stepped"), GOOD)
    done = inside("export", "--vehicle", "pelican", "--history", str(path), "--out", str(tmp_path), "--json", "-")
    assert done.code == 0, done.err
    assert not [text for text in json.loads(done.out)["warnings"] if "set 2" in text]
    shown = inside("history", "--vehicle", "pelican", "--history", str(path), "--json", "-")
    assert json.loads(shown.out)["in_force"] == {"sequence": 2, "doubt": ""}


def test_a_set_that_states_a_slope_of_thrust_is_taken_up_and_exported_as_a_curve(tmp_path: Path, inside: Cli) -> None:
    curved = replace(GOOD, parameters=with_tangent(GOOD.parameters, math.log(0.75), 0.01))
    path = history_of(tmp_path / "h.sqlite", curved)
    pelican = Vehicle.shipped("pelican")
    item = left(path, pelican).item
    assert item is not None
    assert item.parameters["b_tangent"].value == pytest.approx(0.75 * TRUE["b"])
    done = inside("export", "--vehicle", "pelican", "--history", str(path), "--out", str(tmp_path), "--json", "-")
    assert done.code == 0, done.err
    written = ThrustModel.stated(Vehicle.from_yaml(Path(json.loads(done.out)["files"][0]).read_text(encoding="utf-8")))
    plain, weight = ThrustModel.stated(pelican).with_b(TRUE["b"]), pelican.mass * GRAVITY
    assert written.hover_speed(weight) == pytest.approx(plain.hover_speed(weight))
    assert written.slope(weight) == pytest.approx(0.75 * plain.slope(weight))
