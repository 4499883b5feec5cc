"""Any CSV is a recording that keeps its promises or one error that says what is wrong."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from quadid_replay import open_log

from quadid.data.window import Recording
from quadid.errors import QuadidError
from tests.fuzz.campaign import broken_promise

COLUMNS = ("t", "p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz", "phi", "theta", "psi", "x", "y", "z", "vx",
           "vy", "vz", "w1", "w2", "w3", "w4", "u1", "u2", "battery", "speed", "T", " t")  # fmt: skip
NUMBERS = st.floats().map(repr) | st.integers().map(str) | st.sampled_from(("", "1e999", "-0", "0x10", "1_0", "٣", "∞"))
CELLS = NUMBERS | st.text(max_size=6)
NAMES = st.sampled_from(COLUMNS) | st.text(max_size=6)
FEW = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def opened(path: Path, data: bytes) -> Recording | str:
    """The recording, or the error's text."""
    path.write_bytes(data)
    try:
        return open_log(path)
    except QuadidError as error:
        return str(error)


def check(path: Path, data: bytes) -> None:
    """Opens it, and looks what came of it."""
    got = opened(path, data)
    if isinstance(got, str):
        assert "\n" not in got
        assert len(got) < 2000
    else:
        assert not broken_promise(got)


@FEW
@given(
    names=st.lists(NAMES, min_size=1, max_size=8),
    rows=st.lists(st.lists(CELLS, max_size=9), max_size=6),
    separator=st.sampled_from(",;\t |"),
    end=st.sampled_from(("\n", "\r\n", "\r", "\n\n")),
)
def test_any_table_is_a_recording_or_one_error(
    tmp_path: Path, names: list[str], rows: list[list[str]], separator: str, end: str
) -> None:
    lines = [separator.join(row) for row in [names, *rows]]
    check(tmp_path / "log.csv", end.join(lines).encode())


@FEW
@given(
    rows=st.lists(st.tuples(*[NUMBERS] * 8), min_size=1, max_size=8),
    place=st.integers(0, 300),
    noise=st.binary(max_size=8),
)
def test_a_flight_with_any_numbers_and_any_bytes_inside(
    tmp_path: Path, rows: list[tuple[str, ...]], place: int, noise: bytes
) -> None:
    text = "t,p,q,r,w1,w2,w3,w4\n" + "".join(",".join(row) + "\n" for row in rows)
    data = text.encode()
    check(tmp_path / "log.csv", data[:place] + noise + data[place:])


@pytest.mark.parametrize("zone", [b"\xef\xbb\xbf", b"\xff\xfe", b"\x00"])
def test_marks_in_front_of_the_header(tmp_path: Path, zone: bytes) -> None:
    check(tmp_path / "log.csv", zone + b"t,p,q,r,w1,w2,w3\n0,0,0,0,1,1,1\n0.1,0,0,0,1,1,1\n")
