"""Commands, their options and what each gives: the list that users rely on."""

import json
import shlex
from pathlib import Path

import pytest
from quadid_evaluation.studies.health.flights import hover
from quadid_replay import write_csv

from quadid.cli.commands import COMMANDS, load
from quadid.vehicle import Command, Vehicle
from tests.cli.conftest import Flights
from tests.commands import Cli

READING = "--rate --start --stop --preset --unchecked --columns"
FIT = f"LOG --vehicle --validate --seed {READING} --report --series --json --out"
OPTIONS = {
    "demo": "--quick --seed --json --out",
    "simulate": "OUT --vehicle --seconds --seed --effect --profile --manoeuvre --noise --rate --extra --spread --draws "
    "--json",
    "init": "NAME --from --mass --arm --preset --json --out",
    "vehicles": "--json",
    "inspect": "LOG --vehicle --start --stop --preset --columns --json --out",
    "identify": f"{FIT} --optimizer --free --fix --bounds --prior --effect",
    "score": f"LOG --vehicle --horizons --closed-loop {READING} --report --json --out",
    "compare": f"LOG --vehicle --validate --method --seeds --budget --objective --seed {READING} --json --out",
    "diagnose": FIT,
    "health": "LOG --baseline --vehicle --preset --unchecked --report --json --out",
    "excite": "LOG --vehicle --seconds --tilt --rate-limit --height --battery --format --seed --rate --preset "
    "--columns --unchecked --report --json --out",
    "reproduce": "--quick --seed --json --out",
    "replay": "LOG --vehicle --speed --out --rate --window --refit --diagnose --approval --gate --as-recorded "
    "--candidates --seed --preset --columns --json",
    "serve": "--vehicle --mavlink --system --key --zenoh --worker --id --approval --window --refit --diagnose --gate "
    "--history --seconds --seed --json",
    "worker": "--connect --seconds --json",
    "watch": "--zenoh --seconds --approve --rollback --json",
    "history": "--vehicle --history --candidates --events --json",
    "export": "--vehicle --format --list --history --id --anyway --json --out",
    "compare-vehicles": "A B --on --horizons --rate --seed --preset --unchecked --report --json --out",
    "gains": "--vehicle --format --bandwidth --phase-margin --derivative --motor-lag --delay --from --anyway --report "
    "--json --out",
    "fleet": "DIR --vehicle --scheduler --workers --memory --diagnose --again --rate --seed --columns --json --out",
    "warmup": "--json",
}


@pytest.mark.parametrize("name", OPTIONS)
def test_a_command_has_the_options_that_users_know_and_examples_with_them(inside: Cli, name: str) -> None:
    assert list(COMMANDS) == list(OPTIONS)
    command = load(name)
    known = {p.opts[0] if p.param_type_name == "option" else p.metavar for p in command.params}
    assert known == set(OPTIONS[name].split())
    helped = inside(name, "--help").out
    for example in COMMANDS[name].examples:
        assert f"    {example}\n" in helped
        words = shlex.split(example)
        assert words[:2] == ["quadid", name]
        assert command.make_context(name, words[2:])


FULL = Command(kind="normalized", max_speed=800.0)
LATE = "--anyway --motor-lag 0.03 --delay 0"
RESULTS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "score {train} --vehicle pelican": ("quadid.score/1", ("noise floor",), ("Error over the horizon", "Bands: ")),
    "excite --seconds 6.5": ("quadid.excite/1", ("Worth flying: ", "Envelope: "), ("Worth flying: ", "Half-widths")),
    "gains --vehicle {full} " + LATE: ("quadid.gains/1", ("Rate loops of roll", "MC_ROLLRATE_P"), ("What they rest",)),
    "compare-vehicles pelican pelican --on {train}": (
        "quadid.compare_vehicles/1",
        ("Neither file predicts better",),
        ("Errors of B over those of A",),
    ),
    "health {hover}@33: --baseline {hover}@:31 --vehicle pelican_x": (
        "quadid.health/1",
        ("baseline flight",),
        ("Airframe", "sha256"),
    ),
}


@pytest.mark.parametrize("line", RESULTS)
def test_a_result_is_text_json_and_a_page(line: str, inside: Cli, flights: Flights, tmp_path: Path) -> None:
    full = tmp_path / "full.yaml"
    full.write_text(Vehicle.shipped("pelican").model_copy(update={"command": FULL}).to_yaml(), encoding="utf-8")
    hovered = tmp_path / "hover.csv"
    if "{hover}" in line:
        write_csv(hovered, hover(Vehicle.shipped("pelican_x"), seconds=60.0))
    words = shlex.split(line.format(train=flights.train, full=full, hover=hovered))
    schema, printed, shown = RESULTS[line]
    page = tmp_path / "page.html"
    run = inside(*words, "--out", tmp_path, "--report", page, "--json", tmp_path / "r.json")
    assert run.code == 0, run.err
    assert all(text in run.out for text in printed)
    assert f"Report: {page}" in run.out
    result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert (result["schema"], result["report"]) == (schema, str(page))
    html = page.read_text(encoding="utf-8")
    assert all(text in html for text in (*shown, f"quadid {words[0]}"))
