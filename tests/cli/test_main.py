"""The command line: help, usage errors, terminals, pipes, bad input answered in one line."""

import io
import os
import pty
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

import pytest
from quadid_evaluation.paper.compare import Methods
from quadid_node.history import read_history
from quadid_node.mavlink_wire import SafeMavlink, read_key
from quadid_node.wire_format import repeat
from quadid_node.zenoh import config_of
from quadid_replay import open_log
from quadid_replay.writers import open_for_writing

from quadid.app.excite import Proposed
from quadid.app.fleet_page import Fleet
from quadid.app.identify import identify
from quadid.app.logs import OutputError, load, write_recording, write_text, write_texts
from quadid.app.simulate import read_manoeuvre
from quadid.cli.commands import COMMANDS
from quadid.cli.history import Stored
from quadid.cli.main import BLAS_THREADS, Loading
from quadid.cli.replay import Replayed
from quadid.cli.terminal import check_file, show
from quadid.effects import EFFECTS
from quadid.errors import QuadidError, nearest
from quadid.parameters import NOMINAL_UNITS
from quadid.report.manoeuvres import ManoeuvrePlan
from quadid.report.tables import Column, TextTable
from quadid.vehicle import Command, Noise, Vehicle
from quadid.version import __version__
from tests.cli.conftest import Flights
from tests.commands import QUADID, Cli, one_line
from tests.faults.evidence import Happened

# --- The command line as a whole: help, versions, usage errors, quick start


def test_help_lists_every_installed_command(quadid: Cli) -> None:
    run = quadid("--help")
    assert run.code == 0
    for command in COMMANDS:
        assert f"  {command} " in run.out
    assert quadid().out == run.out


def test_the_list_of_commands_is_whole_on_a_narrow_terminal(quadid: Cli) -> None:
    text = " ".join(quadid("--help", COLUMNS="60").out.split())
    assert all(command.short in text for command in COMMANDS.values())


class Terminal(io.StringIO):
    """A stream that is a terminal, or not."""

    def __init__(self, is_one: bool) -> None:
        super().__init__()
        self.is_one = is_one

    def isatty(self) -> bool:
        return self.is_one


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_sees_that_a_command_is_loaded_until_it_prints(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    out, err = Terminal(True), Terminal(terminal)
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    loading = Loading()
    while terminal and not err.getvalue():
        time.sleep(0.02)
    print("answer")
    said = err.getvalue()
    loading.end()
    assert (said.startswith("\rquadid: loading, ") and said.endswith("\r\x1b[2K")) == terminal
    assert (said == "") != terminal
    assert err.getvalue() == said, "erased once"
    assert out.getvalue() == "answer\n"


@pytest.mark.parametrize(
    ("command", "heavy"),
    [
        ("--help", "numpy numba scipy pydantic rich plotly yaml"),
        ("--version", "numpy numba scipy pydantic rich"),
        ("vehicles", "numba scipy plotly"),
        ("init mine", "numba scipy plotly"),
        ("history --vehicle pelican", "numba plotly"),
        ("identify --help", "numba scipy plotly"),
        ("score --help", "numba scipy plotly"),
        ("export --help", "numba scipy plotly"),
    ],
)
def test_what_works_without_a_fit_imports_nothing_heavy(tmp_path: Path, command: str, heavy: str) -> None:
    check = (
        f"import sys; sys.argv = ['quadid', *{command.split()}]; from quadid.cli.main import app_main; app_main(); "
        f"sys.exit(' '.join(set({heavy.split()}) & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", check], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"imported: {done.stderr}"


def test_the_end_of_a_command_does_not_look_through_everything_once_more() -> None:
    check = (
        "import atexit, gc, sys; atexit.register(lambda: print(gc.get_freeze_count(), len(gc.get_objects()))); "
        "sys.argv = ['quadid', '--version']; from quadid.cli.main import app_main; app_main()"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    frozen, left = map(int, done.stdout.split()[-2:])
    assert frozen > 100 * left


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_linear_algebra_takes_one_thread_unless_told_otherwise(given: dict[str, str], used: str) -> None:
    check = (
        "import os, sys; sys.argv = ['quadid', '--version']; from quadid.cli.main import app_main; app_main(); "
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    unset = {n: v for n, v in os.environ.items() if n not in BLAS_THREADS}
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, check=True, env={**unset, **given}
    )
    assert done.stdout.split()[-1] == used


def test_version(inside: Cli) -> None:
    assert inside("--version").out == f"quadid {__version__}\n"


@pytest.mark.parametrize(
    ("slip", "names", "meant"),
    [
        ("motor_lga", EFFECTS, "'motor_lag'?"),
        ("RotorDrag", EFFECTS, "'rotor_drag'?"),
        ("weak_motor", EFFECTS, "'weak_rotor'?"),
        ("bias", EFFECTS, "'gyro_bias' or 'accel_bias'?"),
        ("spin_up", EFFECTS, "'rotor_spin_up'?"),
        ("J_z", NOMINAL_UNITS, "'J_zz'?"),
        ("thruststand", Vehicle.model_fields, "'thrust_stand'?"),
        ("maxspeed", Command.model_fields, "'max_speed'?"),
        ("max_rpm", Command.model_fields, "'max_speed', in SI units, not rpm?"),
        ("range_us", Command.model_fields, "'range'?"),
        ("gyro_dps", Noise.model_fields, "'gyro', in SI units, not dps?"),
        ("compare_vehicles", COMMANDS, "'compare-vehicles'?"),
    ],
)
def test_a_slip_is_told_what_was_meant(slip: str, names: Iterable[str], meant: str) -> None:
    assert nearest(slip, names) == f"did you mean {meant}"


@pytest.mark.parametrize(("other", "names"), [
    ("min_speed", Command.model_fields), ("rate", Command.model_fields), ("accel_scale", EFFECTS),
    ("mag_bias", EFFECTS), ("gyro_noise", EFFECTS), ("rotor_decay", EFFECTS), ("com", EFFECTS),
    ("arm", Vehicle.model_fields),
    ("report", COMMANDS), ("plot", COMMANDS), ("estimate", COMMANDS), ("J_q", NOMINAL_UNITS),
    ("roll_d", ("roll_p", "roll_i")),
])  # fmt: skip
def test_nothing_is_offered_that_means_something_else(other: str, names: Iterable[str]) -> None:
    assert nearest(other, names) == f"use one of {', '.join(names)}"


def test_an_option_that_a_command_lacks_is_not_taken_for_another(inside: Cli) -> None:
    slip = one_line(inside("identify", "f.mcap", "--optimiser", "pso"), 2)
    assert "No such option: --optimiser; fix: did you mean '--optimizer'?" in slip
    assert "No such option: --report; fix: use one of --vehicle, --" in one_line(
        inside("inspect", "f", "--report", "r.pdf"), 2
    )


def test_a_folder_is_no_vehicle_and_what_is_allowed_is_told_once(
    inside: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("logs", "pelican"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert "logs is a directory" in one_line(inside("export", "--vehicle", "logs"), 2)
    assert Vehicle.named("pelican").name == "pelican"
    assert one_line(inside("export", "--vehicle", "x500"), 2).count("hexacopter") == 1


def test_a_span_that_is_written_another_way_is_told_how(inside: Cli, flights: Flights) -> None:
    assert "LOG@START:STOP" in one_line(inside("identify", f"{flights.train}@10-20", "--vehicle", "pelican"), 2)


def test_usage_errors_are_one_line(inside: Cli, flights: Flights) -> None:
    assert "--rat" in one_line(inside("score", "x.csv", "--vehicle", "pelican", "--rat", "5"), 2)
    for rate in ("0", "nan"):
        assert "grid rate" in one_line(inside("identify", flights.train, "--vehicle", "pelican", "--rate", rate), 2)
    assert "--seed" in one_line(inside("identify", "x.csv", "--vehicle", "pelican", "--seed", "x"), 2)


# --- On a terminal: colours, progress, completion; in a pipe: plain text and nothing else


COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-7]m")


def on_a_terminal(arguments: list[str], cwd: Path, **environment: str) -> str:
    """Everything that a command writes to a terminal of 120 columns."""
    leader, follower = pty.openpty()
    plain = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR", "CI", "COLUMNS")}
    process = subprocess.Popen(
        [*QUADID, *arguments],
        stdin=follower,
        stdout=follower,
        stderr=follower,
        cwd=cwd,
        env={**plain, "TERM": "xterm-256color", "COLUMNS": "120", **environment},
    )
    os.close(follower)
    parts = []
    while True:
        try:
            part = os.read(leader, 65536)
        except OSError:  # the last writer has closed the terminal
            break
        if not part:
            break
        parts.append(part)
    os.close(leader)
    assert process.wait(timeout=900) == 0
    return b"".join(parts).decode()


def test_a_terminal_gets_progress_and_no_color_is_respected(flights: Flights, tmp_path: Path) -> None:
    arguments = ["identify", f"{flights.train}@0:12", "--vehicle", "pelican", "--out", str(tmp_path)]
    shown = on_a_terminal(arguments, tmp_path)
    assert " % " in shown
    assert "what is missing" in shown
    assert COLOUR.search(shown)
    assert not COLOUR.search(on_a_terminal(["inspect", str(flights.train)], tmp_path, NO_COLOR="1"))
    assert COLOUR.search(on_a_terminal(["inspect", str(flights.train)], tmp_path))


@pytest.mark.parametrize(
    ("words", "expected"),
    [("quadid i", "inspect"), ("quadid identify --vehicle pel", "pelican_x"), ("quadid diagnose --val", "--validate")],
)
def test_the_shell_completes_commands_options_and_vehicles(quadid: Cli, words: str, expected: str) -> None:
    count = str(len(words.split()) - 1)
    run = quadid(_QUADID_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=count)
    assert expected in run.out.split()


# --- A pipe, a device or a folder where a file is asked for: refused, and not waited for


READERS: dict[str, Callable[[Path], object]] = {
    "vehicle file": Vehicle.named,
    "manoeuvre": read_manoeuvre,
    "signing key": read_key,
    "log": open_log,
    "history that is shown": lambda path: read_history(path, "pelican"),
    "configuration of Zenoh": lambda path: config_of(str(path)),
    "kept input of a failed fit": repeat,
}
WRITERS: dict[str, Callable[[Path], object]] = {
    "result": lambda path: write_text(path, "{}"),
    "log": open_for_writing,
    "vehicle file": Vehicle.shipped("pelican").save,
}


@pytest.mark.parametrize("what", READERS)
def test_what_is_no_file_is_refused(what: str, tmp_path: Path, happened: Happened) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero"), tmp_path):
        with pytest.raises((QuadidError, OSError), match="regular file|[Ii]s a directory|no history|no Zenoh"):
            READERS[what](path)
    happened(35, f"a pipe, /dev/zero and a folder as {what}: refused at once")


@pytest.mark.parametrize("what", WRITERS)
def test_a_pipe_that_nobody_reads_is_not_waited_for_and_stays(what: str, tmp_path: Path, happened: Happened) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises((QuadidError, OSError), match="No such device"):
        WRITERS[what](tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()
    happened(35, f"a {what} to a pipe that nobody reads: refused at once, the pipe is there")


OUTPUTS = {
    "--report": ("identify", "no.csv", "--vehicle", "pelican"),
    "--series": ("identify", "no.csv", "--vehicle", "pelican"),
    "--json": ("diagnose", "no.csv", "--vehicle", "pelican"),
    "--out": ("replay", "no.csv", "--vehicle", "pelican"),
}


@pytest.mark.parametrize("option", OUTPUTS)
@pytest.mark.parametrize("what", ["pipe", "socket", "folder", "file in no folder"])
def test_a_place_that_cannot_be_written_is_said_before_any_work(
    option: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inside: Cli, happened: Happened
) -> None:
    """The log is not even there: only its absence was told, and of a pipe or socket only after all the work."""
    monkeypatch.chdir(tmp_path)
    place = Path("place.html" if option == "--report" else "place.mcap")
    if what == "pipe":
        os.mkfifo(place)
    elif what == "socket":
        socket.socket(socket.AF_UNIX).bind(str(place))
    elif what == "folder" and option != "--series":
        place.mkdir()
    else:
        place = Path("dangling")
        place.symlink_to("nowhere/at/all")
        place = place / "place.html"
    done = inside(*OUTPUTS[option], option, place)
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert "no.csv" not in done.err
    assert option in done.err
    happened(35, f"{option} to a {what}: '{done.err.strip()[:90]}'")


INSIDE = {
    "fleet.logs.parquet": ("fleet", "."),
    "fleet.html": ("fleet", "."),
    "set2.mcap": ("demo", "--quick"),
    "hidden_effect/flight1.mcap": ("demo", "--quick"),
    "paper/figure-3.png": ("reproduce", "--quick"),
    "flights/set1.mcap": ("reproduce", "--quick"),
    "pelican+ground.yaml": ("diagnose", "no.csv", "--vehicle", "pelican"),
    "no.csv.missing.csv": ("identify", "no.csv", "--vehicle", "pelican"),
    "pelican.gains.params": ("gains", "--vehicle", "pelican", "--format", "px4"),
    "pelican.sid_1_roll.param": ("excite", "no.csv", "--vehicle", "pelican", "--format", "ardupilot-sid"),
    "no.csv.inspect.json": ("inspect", "no.csv"),
}


@pytest.mark.parametrize("name", INSIDE)
@pytest.mark.parametrize("what", ["pipe", "folder"])
def test_a_file_in_a_folder_that_cannot_be_written_is_said_before_any_work(
    name: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inside: Cli, happened: Happened
) -> None:
    """They were told when they were written, after all flights and fits; or a pipe was waited for without end."""
    monkeypatch.chdir(tmp_path)
    place = Path("out", name)
    place.parent.mkdir(parents=True)
    (os.mkfifo if what == "pipe" else os.mkdir)(place)
    done = inside(*INSIDE[name], "--series" if "missing" in name else "--out", "out")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert name in done.err
    assert what in done.err or "directory" in done.err
    assert [p for p in Path("out").rglob("*") if p.is_file()] == []
    happened(35, f"{name} in the folder of results is a {what}: '{done.err.strip()[:90]}'")


def test_of_several_files_none_is_written_where_one_cannot_be(tmp_path: Path, happened: Happened) -> None:
    """Those before it were written, beside older ones of its name."""
    texts = {"a.yaml": "new", "b.lua": "new", "c.param": "new"}
    (tmp_path / "b.lua").mkdir()
    with pytest.raises(OutputError, match=r"b\.lua is a directory.*another folder"):
        write_texts(tmp_path, texts)
    assert [p.name for p in tmp_path.iterdir()] == ["b.lua"]
    happened(35, "one of three files of an export is a folder: told, none of the others written")


def test_links_under_the_names_of_what_is_written_over_time_are_replaced(
    flights: Flights, tmp_path: Path, happened: Happened
) -> None:
    """A log of one folder, unpacked with links beside it, had a file elsewhere overwritten."""
    mine = tmp_path / "mine"
    mine.write_text("precious")
    logs = [tmp_path / f"flight.{kind}" for kind in ("csv", "mcap", "tlog")]
    log = load(f"{flights.train}@0:12", "pelican")
    done = identify(log)
    series = [tmp_path / f"{log.name}.{end}" for end in ("simulated.csv", "simulated.mcap", "missing.csv")]
    for path in (*logs, *series):
        path.symlink_to(mine)
    for path in logs:
        write_recording(path, log.recording)
    stamps = tmp_path / "stamps.json"
    for path in (saved := tmp_path / "saved.yaml", stamps):
        path.symlink_to(mine)
        logs.append(path)
    done.vehicle.save(saved)
    coder = SafeMavlink(1, 1, bytes(32), stamps)
    coder.signing.stream_timestamps[1, 1, 1] = 5
    coder.keep(at_once=True)
    assert done.save_series(tmp_path) == series
    assert mine.read_text() == "precious"
    assert not [path for path in (*logs, *series) if path.is_symlink()]
    assert sorted(tmp_path.iterdir()) == sorted([mine, *logs, *series])
    happened(35, f"links under the names of {len(logs) + len(series)} written files: replaced, not followed")


def test_a_pipe_that_is_read_stays_open_until_the_result(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    check_file(tmp_path / "pipe", "--json")
    with pytest.raises(BlockingIOError):  # no end of file
        os.read(reader, 99)
    os.close(reader)


def test_a_pipe_that_is_read_gets_the_result_and_no_device_becomes_a_file(tmp_path: Path) -> None:
    """As root a result for /dev/null took the place of the device."""
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_text(tmp_path / "pipe", "{}")
    assert os.read(reader, 99) == b"{}"
    os.close(reader)
    (tmp_path / "null").symlink_to("/dev/null")
    write_text(tmp_path / "null", "{}")
    assert (tmp_path / "null").is_char_device()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_link_of_the_system_to_a_redirected_file_stays(tmp_path: Path, happened: Happened) -> None:
    """As root `--json /dev/stdout > file` put a file in the place of /dev/stdout."""
    with (tmp_path / "file").open("w") as redirected:
        (tmp_path / "stdout").symlink_to(f"/proc/self/fd/{redirected.fileno()}")
        for place in (tmp_path / "stdout", Path(f"/dev/fd/{redirected.fileno()}")):
            write_text(place, f"{place.parent}")
            assert (tmp_path / "file").read_text() == f"{place.parent}"
        assert (tmp_path / "stdout").is_symlink()
    happened(35, "a result for /dev/stdout that goes to a file: written there, /dev/stdout is the link that it was")


def test_a_pipe_where_time_stamps_of_signatures_were_kept_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "kept.json")
    assert "no regular file" in SafeMavlink(1, 1, bytes(32), tmp_path / "kept.json").problem


# --- What commands print fits a narrow terminal: lines fold, and every value stands there whole


PARAMETERS = [
    {
        "name": name,
        "unit": unit,
        "value": 1.23456e-5 * (i + 1),
        "ci95": [1.23356e-5 * (i + 1), 1.23556e-5 * (i + 1)],
        "initial": 2e-5,
        "status": "identified",
    }
    for i, (name, unit) in enumerate(NOMINAL_UNITS.items())
]
SET = {
    "sequence": 3,
    "wall": 1.7e9,
    "state": "rolled_back",
    "approved_by": "operator",
    "start": 1.0,
    "stop": 59.0,
    "mse": 1.234,
    "parameters": PARAMETERS,
    "reason": "it predicts new windows worse than its predecessor",
    "reference": "none",
    "reference_sd": 0.09,
}
METHOD = {
    "name": "differential_evolution",
    "mse": {"train": 1.2345, "validate": [2.3456, 3.4567]},
    "mse_paper": {"train": 4.5678},
    "evaluations": 4000,
    "seconds": 12.3,
    "failures": 1,
    "runs": 3,
    "note": "stopped",
}
EXCITED = {
    "seconds": 58.5,
    "worst": "J_r",
    "gain": 7.3,
    "manoeuvre_file": "m.yaml",
    "files": [],
    "parameters": [
        {"name": name, "now": 0.00569, "gentle_flight": 0.00567, "manoeuvre": 0.00409, "one_axis_at_a_time": 0.00543}
        for name in NOMINAL_UNITS
    ],
    "movements": [{"name": "roll + pitch + yaw + throttle, 0.8 to 2 Hz", "amplitudes": {"roll": 0.2, "yaw": 0.15}}],
    "peak": {"tilt_deg": 23.0, "rate_deg_s": 120.0},
    "room": {"sideways_m": 5.0, "up_m": 0.1, "down_m": 0.1},
    "envelope": {"lowest_m": 10, "highest_m": 40, "radius_m": 10, "abort_tilt_deg": 32, "battery_percent": 40},
}
COMPARED = {"validate": ["other.mcap", "third.mcap"], "methods": [METHOD], "budget": 4000}
REPLAYED = {"vehicle": "pelican", "events": [], "refused": {"held_out_gain": 27}, "published": [SET], "status": {}}
STORED = {"vehicle": "pelican", "sets": [SET], "vehicles": [], "candidates": [], "events": [], "in_force": None}
FLEET = {
    "units": [{"unit": "airframe-07", "logs": 2, "done": 2, "parameters": [
        {"parameter": n, "unit": u, "median": 1.23456e-5, "spread": 0.0123} for n, u in NOMINAL_UNITS.items()
    ]}],
    "counts": {"done": 2}, "rough": 0, "drifts": [], "outliers": [], "reasons": [], "health": [], "worked": 2,
    "logs": 2, "copies": [], "seconds": 1.0, "files": [], "report": "fleet.html",
}  # fmt: skip
SHOWN: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "excite": (
        lambda: show(
            Proposed(EXCITED, *[cast(Any, x) for x in (None, None, ManoeuvrePlan("p", 1.0, [], [], {}, {}, {}), 0.5)]),
            None,
        ),
        ("0.569 %", "0.567 %", "0.409 %", "0.543 %"),
    ),
    "compare": (
        lambda: show(Methods(COMPARED), None),
        ("differential_evolution", "1.234", "2.346", "3.457", "4000", "12.3", "1/3"),
    ),
    "fleet": (lambda: show(Fleet(FLEET, [], []), None), ("airframe-07", "J_xx", "1.235e-05", "N s^2/rad^2", "1.2 %")),
    "replay": (lambda: show(Replayed(REPLAYED), None), ("1.2346e-05", "7.4074e-05", "identified", "held out gain")),
    "history": (
        lambda: show(Stored(STORED), None),
        ("operator", "rolled_back", "1.23", "1.235e-05", "7.407e-05", "predecessor"),
    ),
}


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("command", SHOWN)
def test_every_value_stands_whole(
    command: str, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    show, values = SHOWN[command]
    show()
    text = capsys.readouterr().out
    assert "…" not in text
    assert not [line for line in text.splitlines() if len(line) > width]
    assert not [value for value in values if value not in text]


def test_columns_beyond_the_width_stand_below_with_the_first_beside_them() -> None:
    columns = (Column("set"), *(Column(f"column {i}", right=True) for i in range(5)))
    table = TextTable("t", columns, (("a", "1", "2", "3", "4", "5"),))
    assert table.text(60).splitlines()[1].split("  ")[-1] == "column 4"
    narrow = table.text(25).splitlines()
    assert [line.split()[0] for line in narrow[1:] if line] == ["set", "a"] * 3
    assert max(map(len, narrow)) <= 25


# --- Whatever is wrong with the input: one line that says what and how to mend it, exit code 2 or 3, no traceback


def test_a_truncated_log_is_used_as_far_as_it_goes(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    whole = flights.unseen.read_bytes()
    cut = tmp_path / "cut.csv"
    cut.write_bytes(whole[: len(whole) // 2])
    run = inside("score", cut, "--vehicle", "pelican", "--json", "-")
    assert run.code == 0
    assert 650 < run.data["samples"] < 750
    assert "cut.csv" in run.err


def test_what_is_allowed_is_said_once(inside: Cli, flights: Flights) -> None:
    line = one_line(inside("compare", flights.train, "--vehicle", "pelican", "--method", "magic"), 2)
    assert line.count("l_shade") == 1
    assert "fix" not in line


def test_places_that_cannot_be_written(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    common = ("identify", flights.train, "--vehicle", "pelican")
    assert "file" in one_line(inside(*common, "--out", file), 2)
    assert "directory" in one_line(inside(*common, "--report", tmp_path), 2)


def test_the_vehicle_file_read_is_never_overwritten(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    text = Vehicle.shipped("pelican").to_yaml()
    for command, ending in (("identify", "fitted"), ("diagnose", "diagnosed")):
        file = tmp_path / f"pelican.{ending}.yaml"
        file.write_text(text, encoding="utf-8")
        run = inside(command, f"{flights.train}@0:12", "--vehicle", file, "--out", tmp_path, "--json", "-")
        assert run.code == 0, run.err
        assert run.data["vehicle_file"] == str(tmp_path / f"pelican.{ending}.new.yaml")
        assert file.read_text(encoding="utf-8") == text


def test_impossible_horizons(inside: Cli, flights: Flights) -> None:
    for horizons in ("0", "1,x", "", "99999"):
        one_line(inside("score", flights.train, "--vehicle", "pelican", "--horizons", horizons), 2)
    line = one_line(inside("score", flights.train, "--vehicle", "pelican", "--horizons", "1900"), 3)
    assert "no run of 1900 samples fits" in line


def test_control_characters_in_names_do_not_reach_the_terminal(inside: Cli, tmp_path: Path, happened: Happened) -> None:
    run = inside("score", str(tmp_path / "evil\x1b[31m\nname.csv"), "--vehicle", "pelican")
    assert "\x1b" not in run.err
    one_line(run, 2)
    happened(20, "ANSI and line ends in a file name: none on the terminal, one line")


def test_the_vehicle_file_of_a_vehicle_thirty_times_as_heavy(inside: Cli, tmp_path: Path, data_dir: Path) -> None:
    """Its rotors stand in another order as well, but that is not what to mend."""
    log = data_dir / "crazyflie_rpm" / "figure8_17.csv"
    run = inside("identify", log, "--vehicle", "pelican", "--out", tmp_path)
    line = one_line(run, 2)
    assert "so b would be 1.26e-06" in line
    assert "fix: use the vehicle file of this log; else" in line
