"""Commands, their options and what each gives: the list that users rely on."""

from __future__ import annotations

import shlex

import pytest

from quadid.cli.commands import COMMANDS, load
from tests.cli.conftest import Cli

READING = "--rate --start --stop --preset --unchecked --columns"
FIT = f"LOG --vehicle --validate --seed {READING} --report --series --json --out"
OPTIONS = {
    "demo": "--quick --seed --json --out",
    "simulate": "OUT --vehicle --seconds --seed --effect --profile --manoeuvre --noise --rate --extra --spread --draws "
    "--json",
    "init": "NAME --from --mass --arm --preset --json --out",
    "vehicles": "--json",
    "inspect": "LOG --vehicle --start --stop --preset --columns --json --out",
    "identify": f"{FIT} --optimizer",
    "score": f"LOG --vehicle --horizons --closed-loop {READING} --json --out",
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
