"""Names and histories of strangers: harmless in reader, terminal, report and history."""

import contextlib
import json
import sqlite3
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import Store, read_history
from quadid_node.messages import set_to_dict
from quadid_replay import open_log
from quadid_replay.schemas import schema_text

from quadid.data.window import Recording
from quadid.errors import LogError, VehicleError
from quadid.report.templating import environment
from quadid.sanitise import LONGEST_LINE
from quadid.vehicle import Vehicle
from tests.commands import Cli, inside
from tests.faults.evidence import Happened
from tests.fuzz.seeds import mcap_of
from tests.online.test_gate import TRUE, online_set
from tests.replay.test_dataflash import flight as dataflash_flight
from tests.replay.test_mcap import imu
from tests.replay.test_ulog import Ulog
from tests.replay.test_ulog import flight as ulog_flight
from tests.report.test_page import EVIL, page, scored

# --- Names of a megabyte with HTML, ANSI, NUL and SQL in them: harmless in reader, terminal, report and history


__all__ = ["inside"]
MEGABYTE = 1 << 20
MARKED = "x"
HOSTILE = "<script>alert(1)</script>\x1b[31m\x00'; DROP TABLE sets; --\u202e"
NAME = HOSTILE * (MEGABYTE // len(HOSTILE) + 1)


def csv_log() -> bytes:
    rows = "".join(f"{0.02 * k},0,0,0,400,400,400,400,1\n" for k in range(200))
    return f't,p,q,r,w1,w2,w3,w4,"{NAME}"\n{rows}'.encode()


def mcap_log() -> bytes:
    kind = "sensor_msgs/msg/Imu"
    text = schema_text(kind)
    return mcap_of([("imu", kind, text, imu), (NAME, kind, text, imu)], summary=True)


def mcap_type() -> bytes:
    """The type's name is hostile; the definition in the log too."""
    kind, text = "sensor_msgs/msg/Imu", schema_text("sensor_msgs/msg/Imu")
    return mcap_of([("imu", kind, text, imu), ("other", kind, text, imu)], True, shown=f"float64 x # {NAME}\n")


def ulog_log() -> bytes:
    """As long as a record can be: 65,535 bytes."""
    log, long = ulog_flight(count=200), NAME[:60_000]
    extra = Ulog()
    extra.format(long, "uint64_t timestamp;float x;")
    extra.subscribe(long)
    extra.add(long, "Qf", 6_000_000, 1.0)
    extra.parameter(HOSTILE[:50], 1.0)
    extra.record("I", bytes([20]) + b"char[20] " + b"x" * 11 + long.encode("ascii", "replace"))
    return bytes(log.data) + bytes(extra.data[16:])


def dataflash_log() -> bytes:
    """Its names have room for 16 bytes only."""
    log = dataflash_flight()
    log.add("PARM", 0, HOSTILE[25:41].encode()[:16], 1.0)
    return bytes(log.data)


LOGS: dict[str, Callable[[], bytes]] = {
    "csv column": csv_log,
    "mcap topic": mcap_log,
    "mcap definition": mcap_type,
    "ulog message": ulog_log,
    "dataflash parameter": dataflash_log,
}


@pytest.fixture(params=sorted(LOGS))
def log(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    path = tmp_path / "log"
    path.write_bytes(LOGS[request.param]())
    return request.param, path


def texts(recording: Recording) -> list[str]:
    sources = [text for channel in recording.channels.values() for text in (channel.name, channel.source)]
    return [recording.name, recording.format, *recording.warnings, *sources]


def test_a_reader_and_the_terminal_show_a_bounded_part_without_control_characters(
    log: tuple[str, Path], inside: Cli, happened: Happened
) -> None:
    what, path = log
    try:
        said = texts(open_log(path))
    except LogError as error:
        said = [str(error)]
    assert all(text.isprintable() and len(text) <= LONGEST_LINE for text in said)
    run = inside("inspect", path, "--vehicle", "pelican")
    told = run.out + run.err
    assert run.code in (0, 2, 3)
    assert "Traceback" not in told
    assert not set(told) - {"\n"} & set(map(chr, range(32))) or "\x1b" not in told
    assert "\x00" not in told
    assert "\u202e" not in told
    assert len(told) < 20 * LONGEST_LINE
    happened(
        20,
        f"{what} of {path.stat().st_size >> 10} KiB with HTML, ANSI, NUL, SQL: nothing longer than "
        f"{max(map(len, said))} characters from the reader, {len(told)} on the terminal, no control character",
    )


def test_a_megabyte_of_hostile_text_in_a_report_stays_text_and_data(happened: Happened) -> None:
    shown = page([scored(NAME)])
    assert "<script>alert(1)</script>\x1b" not in shown
    assert shown.count("<script") == page([scored(EVIL)]).count("<script")
    happened(20, f"log name of {len(NAME) >> 10} KiB in a report: escaped everywhere, no element made of it")


def test_a_vehicle_with_a_megabyte_name_is_refused_in_one_short_line(happened: Happened) -> None:
    data = Vehicle.shipped("pelican").to_yaml().replace("name: pelican", f"name: {json.dumps(NAME)}", 1)
    with pytest.raises(VehicleError) as caught:
        Vehicle.from_yaml(data)
    assert len(str(caught.value)) < LONGEST_LINE
    assert "characters; allowed: up to" in str(caught.value)
    happened(20, f"vehicle file with a name of a megabyte: refused, '{str(caught.value)[:90]}'")


def test_a_megabyte_in_the_history_is_one_value_and_no_statement(tmp_path: Path, happened: Happened) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, NAME)
    store.numbered(replace(online_set(TRUE), sequence=1, reason=NAME, approved_by="auto"))
    store.close(30.0)
    found: list[dict[str, Any]] = read_history(path, NAME)["sets"]
    assert [s["reason"] for s in found] == [NAME]
    assert all(len(p.name) < 120 for p in tmp_path.iterdir())
    happened(20, "vehicle name and reason of a megabyte in the history: stored and found again bit for bit")


def test_packed_lengths_are_true() -> None:
    """A ULog record's length is two bytes: more than that cannot be written."""
    with pytest.raises(struct.error):
        Ulog().record("I", bytes(1 << 16))


@pytest.mark.parametrize("name", ["x\nimport os", "x\u2028y", "x\u202ey", "x\u200by", "x\x85y", "x\x1b[31m", "x\x00y"])
def test_a_name_that_does_not_print_makes_no_script(name: str, tmp_path: Path, inside: Cli, happened: Happened) -> None:
    file = tmp_path / "evil.yaml"
    named = Vehicle.shipped("pelican_x").to_yaml().replace("name: pelican_x", f"name: {json.dumps(name)}", 1)
    file.write_text(named)
    for command in (
        ("excite", "--vehicle", file, "--seconds", "12", "--format", "ardupilot-lua", "--out", tmp_path),
        ("export", "--vehicle", file, "--format", "gazebo", "--out", tmp_path),
    ):
        run = inside(*command)
        assert run.code == 2
        assert "does not print" in run.err
        assert run.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [file]
    happened(33, f"vehicle named {name!a}: '{run.err.strip()[:90]}', nothing written")


def test_a_name_full_of_markup_is_a_name(tmp_path: Path, inside: Cli, happened: Happened) -> None:
    name = """a'b" canonical_link="x"/> @NAME@ {{ v }} --><x/> ]]> \\ ${y} `z` <!-- %s"""
    file = tmp_path / "evil.yaml"
    file.write_text(Vehicle.shipped("pelican_x").model_copy(update={"name": name}).to_yaml())
    done = inside("export", "--vehicle", file, "--format", "gazebo", "--out", tmp_path, "--json", "-")
    assert done.code == 0, done.err
    text = Path(done.data["files"][0]).read_text(encoding="utf-8")
    (model,) = ET.fromstring(text).iter("model")
    assert model.attrib["name"] == name
    assert MARKED not in {element.tag for element in ET.fromstring(text).iter()}
    done = inside("export", "--vehicle", file, "--format", "rotorpy", "--out", tmp_path, "--json", "-")
    compile(Path(done.data["files"][0]).read_text(encoding="utf-8"), "x", "exec")
    happened(33, f"vehicle named {name[:30]}…: the same name in SDF by an XML parser, and a module that compiles")


def test_text_without_a_filter_is_refused_at_once_whatever_its_length() -> None:
    """Each letter more once doubled the time."""
    template = environment("param").from_string("{{ x }}")
    for text in ("a" * LONGEST_LINE + "!", "a b", "--", "x\n"):
        with pytest.raises(ValueError, match="without a filter"):
            template.render(x=text)
    assert template.render(x="-1.5e-3+x") == "-1.5e-3+x"


# --- A history that a stranger filled: shown without a character that a terminal acts on, or refused in one line


EVIL_TEXT = "\x1b[31mred\u202eevil\u2028x\x85y\x9bz\x00 [bold red]m[/] <script>"
FIELDS = ("reason", "approved_by", "outdated", "check", "input_hash")
ROWS: dict[str, tuple[str, object]] = {
    "texts": ("data", json.dumps({**set_to_dict(online_set(TRUE)), **dict.fromkeys(FIELDS, EVIL_TEXT)})),
    "a time of 1e300": ("wall", 1e300),
    "a time of words": ("wall", "abc"),
    "a time of bytes": ("wall", b"\xff"),
    "an endless time": ("wall", float("inf")),
    "a list": ("data", "[]"),
    "a number": ("data", "3"),
    "bytes": ("data", b"\xff\xfe"),
    "words for a stamp": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "stop": "x"})),
    "no state": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "state": None})),
    "parameters that are none": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "parameters": [1]})),
}


@pytest.mark.parametrize("what", ROWS)
def test_a_history_of_a_stranger_is_shown_as_text_or_refused_in_one_line(
    what: str, tmp_path: Path, inside: Cli, happened: Happened
) -> None:
    path, (column, value) = tmp_path / "h.sqlite", ROWS[what]
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=7, approved_by="auto"))
    assert store.flush(10.0)
    store.close(60.0)
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute(f"UPDATE sets SET {column} = ?", (value,))
        db.execute(
            "INSERT INTO events (vehicle, level, kind, text, t, wall) VALUES ('pelican', ?, ?, ?, 1.0, 1e9)",
            (EVIL_TEXT, EVIL_TEXT, EVIL_TEXT),
        )
    run = inside("history", "--vehicle", "pelican", "--history", path, "--events", "9", "--json", "-")
    shown = inside("history", "--vehicle", "pelican", "--history", path, "--events", "9")
    for told in (run, shown):
        assert told.code == (0 if what == "texts" else 2), told.err
        assert all(c.isprintable() or c == "\n" for c in told.out + told.err)
        assert "Traceback" not in told.err
    if what == "texts":
        assert run.data["events"][0]["text"] == EVIL_TEXT, "JSON holds it, escaped"
        assert shown.out.count("evil") >= 4
    else:
        assert shown.err.count("\n") == 1
    happened(44, f"stored sets with {what}: `quadid history` ends with {shown.code}, no control character")
