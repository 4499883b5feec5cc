"""Any arguments after `quadid`: an exit code of the contract, one line of reason, no traceback."""

import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from quadid.cli.main import app_main

COMMANDS = ("simulate", "inspect", "identify", "score", "compare", "diagnose", "excite", "replay", "history", "export",
            "fleet", "watch", "serve", "demo", "reproduce")  # fmt: skip
NOT_STARTED = ("watch", "serve", "demo", "reproduce", "fleet", "simulate", "excite")
"""Commands that may run for long once their arguments are right: only tried with an option that does not exist."""
OPTIONS = ("--vehicle", "--json", "--out", "--seconds", "--seed", "--effect", "--rate", "--validate", "--optimizer",
           "--horizons", "--speed", "--format", "--history", "--start", "--stop", "--preset", "--report")  # fmt: skip
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x00/"), max_size=12)
"""Without a slash: what is written stays in the test's own folder."""
VALUES = WORDS | st.floats().map(repr) | st.sampled_from(
    ("nan", "-1", "1e999", "pelican", "/dev/null", "none/there", "rotor_drag:k_x=nan", "rotor_drag:", "-", "--",
     "1,1,nan")
)  # fmt: skip
ARGUMENTS = st.lists(st.sampled_from(OPTIONS) | VALUES, max_size=5)


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(command=st.sampled_from(COMMANDS) | WORDS, arguments=ARGUMENTS)
def test_any_arguments_end_with_a_code_of_the_contract(
    command: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    last = ["--no-such-option"] if command in NOT_STARTED else []
    monkeypatch.setattr(sys, "argv", ["quadid", command, *arguments, *last])
    capfd.readouterr()
    code = app_main()
    told = capfd.readouterr()
    assert code in (0, 2, 3), (command, arguments, told.err)
    assert "Traceback" not in told.err
    assert "\x1b" not in told.err
    if code:
        assert told.err.strip(), "says why"
        assert len(told.err) < 6000
