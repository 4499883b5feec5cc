"""The process in which logs are read: what comes out of it, its limits, and that no format can get around them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import numpy as np
import pytest
import quadid_replay.opening
from quadid_replay import open_log, write_csv, write_mcap, write_tlog
from quadid_replay.formats import read_here
from quadid_replay.opening import Answer, BadAnswerError, ReadLimits, limits, pack, unpack

from quadid.data.window import Recording
from quadid.errors import LogError
from tests.faults.evidence import Happened
from tests.fuzz.formats import FORMATS
from tests.fuzz.seeds import seeds
from tests.replay.synthetic import full_recording


def same(one: Recording, other: Recording) -> None:
    assert {**vars(one), "channels": None} == {**vars(other), "channels": None}
    assert list(one.channels) == list(other.channels)
    for name, channel in one.channels.items():
        found = other.channels[name]
        assert (found.t.tobytes(), found.values.tobytes()) == (channel.t.tobytes(), channel.values.tobytes())
        assert (found.values.shape, found.source, found.faults) == (
            channel.values.shape,
            channel.source,
            channel.faults,
        )
        assert not found.values.flags.writeable


@pytest.mark.parametrize("kind", ["mcap", "rosbag2", "tlog", "dataflash", "ulog", "usdlog", "blackbox"])
def test_a_child_reads_what_is_read_here(tmp_path: Path, kind: str) -> None:
    (tmp_path / "log").write_bytes(FORMATS[kind].finish(seeds(kind)[0]))
    same(read_here(tmp_path / "log", "auto"), open_log(tmp_path / "log"))


def test_reading_processes_import_neither_numba_nor_scipy_nor_pydantic() -> None:
    """One constant of `quadid.data.grid` in a reader took the first log of a program a second."""
    script = (
        "import sys, quadid_replay.opening\nfrom quadid_replay.formats import FORMATS, reader_of\n"
        "for kind in FORMATS:\n    reader_of(kind.name)\nprint({'numba', 'scipy', 'pydantic'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_folder_may_take_what_its_files_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits were those of the folder's own entry, 4 kB: a recording of 500 MB had 10 s and 768 MiB."""
    folder, allowed = tmp_path / "bag", list[int]()
    folder.mkdir()
    for part in range(2):
        write_mcap(folder / f"bag_{part}.mcap", full_recording(4.0, 500.0))
    files = ", ".join(f"bag_{part}.mcap" for part in range(2))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths: [{files}]\n")

    def noted(size: int) -> ReadLimits:
        allowed.append(size)
        return limits(size)

    monkeypatch.setattr(quadid_replay.opening, "limits", noted)
    assert open_log(folder).channels
    assert allowed == [sum(file.stat().st_size for file in folder.glob("*.mcap"))]


@pytest.mark.parametrize("path", ["", os.pathsep])
def test_no_code_of_the_folder_we_stand_in_is_run(tmp_path: Path, path: str, happened: Happened) -> None:
    """A packed folder of logs may hold a json.py; an empty name in PYTHONPATH means that folder."""
    write_mcap(tmp_path / "a.mcap", full_recording(1.0, 50.0))
    (tmp_path / "json.py").write_text("open('ran', 'w').close()\nraise SystemExit\n")
    script = (
        "import json, os\nfrom quadid_replay import open_log\n"
        f"os.environ['PYTHONPATH'] = {path!r}\nprint(len(open_log('a.mcap').channels))\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert int(done.stdout) > 4, done.stderr
    assert not (tmp_path / "ran").exists()
    happened(25, "a log beside a json.py in the folder we stand in: read, and that file is not run")


def test_more_memory_than_allowed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    path = tmp_path / "big.csv"
    path.write_text("t,p,q,r\n" + "".join(f"{k * 1e-3:.3f},0,0,0\n" for k in range(20_000)) * 40)
    monkeypatch.setenv("QUADID_READ_MEMORY_MB", "60")
    with pytest.raises(LogError, match="big.csv: reading it takes more than 60 MiB of memory.*QUADID_READ_MEMORY_MB"):
        open_log(path)
    happened(5, f"CSV of {path.stat().st_size >> 20} MB under a limit of 60 MiB: the child is stopped, the log refused")


def test_errors_are_those_of_the_reader_and_limits_are_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "b.csv").write_text("t,p\n0,1\n")
    with pytest.raises(LogError, match="gyro lacks column q, r; allowed: all of p q r"):
        open_log(tmp_path / "b.csv")
    monkeypatch.setenv("QUADID_READ_SECONDS", "soon")
    with pytest.raises(LogError, match="QUADID_READ_SECONDS='soon'; allowed: a positive number"):
        open_log(tmp_path / "b.csv")


AT_ONCE = """
import multiprocessing, sys
from concurrent.futures import ThreadPoolExecutor
from quadid_replay import open_log

def rows(path):
    return len(open_log(path).channels["gyro"].t)

paths = [sys.argv[1 + k % 4] for k in range(24)]
with ThreadPoolExecutor(8) as pool:
    found = list(pool.map(open_log, paths))
assert [r.name for r in found] == [p.rsplit("/", 1)[1] for p in paths]
assert len({len(r.channels["gyro"].t) for r in found}) == 4
with multiprocessing.get_context("fork").Pool(2) as forked:
    assert forked.map(rows, paths) == [len(r.channels["gyro"].t) for r in found]
assert rows(paths[0]) == len(found[0].channels["gyro"].t), "the process that forked still has its own"
"""
"""Read by a program of its own: the threads that other tests have left here must not be forked."""


def test_threads_and_forked_processes_read_at_once(tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.csv" for k in range(4)]
    for k, path in enumerate(paths):
        write_csv(path, full_recording(1.0 + k, 50.0))
    done = subprocess.run(
        [sys.executable, "-c", AT_ONCE, *map(str, paths)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_reading_process_that_was_killed_is_started_again(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", full_recording(1.0, 50.0))
    for _ in range(2):
        assert open_log(tmp_path / "a.csv").channels
        process = quadid_replay.opening._PROCESS._process
        assert process is not None
        process.kill()
        process.wait()


def test_a_reading_process_that_is_killed_with_a_request_in_its_hands_is_asked_again(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", full_recording(1.0, 50.0))
    assert open_log(tmp_path / "a.csv").channels
    process = quadid_replay.opening._PROCESS._process
    assert process is not None
    process.send_signal(signal.SIGSTOP)
    with ThreadPoolExecutor() as pool:
        read = pool.submit(open_log, tmp_path / "a.csv")
        time.sleep(0.3)  # asked by now; a later request meets a dead process, as above
        process.kill()
        assert read.result().channels


def test_an_answer_is_checked_at_the_door() -> None:
    recording = full_recording(0.1, 50.0)
    whole = pack(Answer(recording))
    same(recording, unpack(whole))
    line = msgspec.msgpack.decode(whole)["recording"]
    name, first = next(iter(line["channels"].items()))
    (rows, columns), values = first["values"]

    def changed(channel: Mapping[str, object] | None = None, **fields: object) -> bytes:
        channels = {**line["channels"], name: {**first, **(channel or {})}}
        return msgspec.msgpack.encode({"recording": {**line, "channels": channels, **fields}})

    not_finite = np.full(rows * columns, np.nan).tobytes()
    for bad in (
        b"", b"\x80", b"\x80\x04.", whole[:-8], whole + bytes(8), changed({"values": ((rows, columns), not_finite)}),
        changed({"name": "os"}), changed({"name": "battery"}), changed({"values": ((rows, 1 << 60), values)}),
        changed({"t": ((rows - 1,), first["t"][1][:-8])}),
        changed({"t": ((rows,), first["t"][1][:-3])}), changed({"faults": {"x": -1}}), changed(epoch="now"),
        changed(epoch=np.inf), changed(warnings=[["x"]]), changed(breaks=[np.nan]), changed(modes=None),
    ):  # fmt: skip
        with pytest.raises(BadAnswerError):
            unpack(bad)
    told = unpack(changed(warnings=["a\x1b[2Jb\nc" + "x" * 10_000]))
    assert told.warnings[0].startswith("a?[2Jb?c")
    assert len(told.warnings[0]) <= 2000


# A format of somebody else, added as CONTRIBUTING.md describes, and one that does what its file says.

HARMFUL = """
import os, signal, socket, tempfile, time
from pathlib import Path

def read_harm(path):
    deed = path.read_bytes()[4:].decode()
    if deed == "compute":
        while True:
            pass
    if deed == "sleep":
        signal.sigwait([signal.SIGUSR1])
    if deed == "take memory":
        kept = []
        while True:
            kept.append(bytearray(1 << 24))
    if deed == "write":
        with open(path.with_suffix(".written"), "wb", buffering=0) as file:
            while True:
                file.write(bytes(1 << 20))
    if deed == "open":
        kept = []
        while True:
            kept.append(path.open())
    if deed == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if deed == "leave":
        os._exit(0)
    if deed == "print":
        print("x" * 100_000)
    raise KeyError(deed)
"""


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    """A folder with the package in it, to which the formats were added."""
    folder = tmp_path_factory.mktemp("extended")
    shutil.copytree(repository / "replay" / "quadid_replay", folder / "quadid_replay")
    page = (repository / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Adding a log format")[2]
    reader, line = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (folder / "quadid_replay" / "xyz_reader.py").write_text(reader)
    (folder / "quadid_replay" / "harm_reader.py").write_text(HARMFUL)
    table = folder / "quadid_replay" / "formats.py"
    added = f'    {line.strip()},\n    LogFormat("harm", b"HARM", "harm_reader:read_harm"),\n'
    table.write_text(table.read_text().replace("FORMATS = (\n", f"FORMATS = (\n{added}"))
    return folder


def told(folder: Path, *paths: Path, seconds: str = "", memory: str = "") -> list[str]:
    """Answers of `open_log` of that folder's package to these files, in another process."""
    script = (
        "import json, sys\nfrom quadid.errors import LogError\nfrom quadid_replay import open_log\n"
        "for path in sys.argv[1:]:\n    try:\n        log = open_log(path)\n"
        "        print(json.dumps(repr((log.format, log.warnings, {n: c.values[-1].tolist() for n, c in "
        "log.channels.items()}))))\n"
        "    except LogError as error:\n        print(json.dumps(str(error)))\n"
    )
    env = {**os.environ, "PYTHONPATH": str(folder), "QUADID_READ_SECONDS": seconds, "QUADID_READ_MEMORY_MB": memory}
    command = [sys.executable, "-c", script, *map(str, paths)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == len(paths), done.stderr
    return lines


def test_the_format_of_the_page_is_read(tmp_path: Path, extended: Path) -> None:
    rows = np.zeros(50, np.dtype([("t", "<u8"), ("gyro", "<f4", 3), ("motor", "<u2", 4)]))
    rows["t"], rows["gyro"], rows["motor"] = 20_000 * np.arange(50), (0.5, 0.25, -1.0), 65535
    (tmp_path / "a").write_bytes(b"XYZ1" + rows.tobytes())
    (tmp_path / "cut").write_bytes(b"XYZ1" + rows.tobytes() + b"rest")
    whole, cut = told(extended, tmp_path / "a", tmp_path / "cut")
    assert whole == repr(("xyz", (), {"gyro": [0.5, -0.25, 1.0], "motor_command": [1.0] * 4}))
    assert "it was cut" in cut


def test_a_format_that_does_harm_is_stopped_by_its_limit(tmp_path: Path, extended: Path, happened: Happened) -> None:
    expected = {
        "compute": "takes longer than 1 s of processor time.*QUADID_READ_SECONDS",
        "sleep": "takes longer than 10 s by the clock.*QUADID_READ_SECONDS",
        "take memory": "takes more than 300 MiB of memory.*QUADID_READ_MEMORY_MB",
        "write": "reading it writes files",
        "open": "opens too many files",
        "crash": "its reader ended with SIGSEGV.*QUADID_READ_MEMORY_MB",
        "leave": "returned is no recording",
        "print": "its reader failed .KeyError: 'print'.*report it",
        "a strange thing": "its reader failed .KeyError.*harm_reader.py.*report it",
    }
    paths = []
    for deed in expected:
        paths.append(tmp_path / deed.replace(" ", "-"))
        paths[-1].write_bytes(b"HARM" + deed.encode())
    for (deed, pattern), said in zip(
        expected.items(), told(extended, *paths, seconds="0.5", memory="300"), strict=True
    ):
        assert re.search(pattern, said), (deed, said)
        assert "fix: " in said, said
    written = sum(path.stat().st_size for path in tmp_path.glob("*.written"))
    assert written == 0
    happened(5, f"a reader that {', '.join(list(expected)[:6])}s: each stopped by its limit, which the error names")


def test_a_reader_ends_with_the_program_that_asked(tmp_path: Path, extended: Path) -> None:
    (tmp_path / "log").write_bytes(b"HARMsleep")
    script = f"from quadid_replay import open_log; print(flush=True); open_log({str(tmp_path / 'log')!r})"
    env = {**os.environ, "PYTHONPATH": str(extended)}
    with subprocess.Popen([sys.executable, "-c", script], env=env, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        program.stdout.readline()
        while len(below := [*_descendants(program.pid)]) < 2:
            assert program.poll() is None
        program.send_signal(signal.SIGKILL)
    while any(Path(f"/proc/{pid}").exists() and not _zombie(pid) for pid in below):
        pass


def _zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def _descendants(pid: int) -> Iterator[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return
    for child in map(int, children):
        yield child
        yield from _descendants(child)


def sparse(path: Path, head: bytes, size: int) -> Path:
    path.write_bytes(head)
    os.truncate(path, size)
    return path


@pytest.mark.parametrize("kind", ["mcap", "tlog", "dataflash", "ulog", "usdlog", "csv"])
def test_a_log_of_10_gb_that_holds_nothing_is_refused_unread(tmp_path: Path, kind: str, happened: Happened) -> None:
    head = b"t,p,q,r\n0,0,0,0\n0.1,0,0,0\n" if kind == "csv" else seeds(kind)[0]
    path = sparse(tmp_path / "huge", head, 10 << 30)
    with pytest.raises(LogError, match="10240 MiB of which 0 MiB are stored"):
        open_log(path)
    happened(5, f"10 GB {kind} (a true head, then nothing): refused before it is read")


def test_a_line_without_end_is_refused(tmp_path: Path, happened: Happened) -> None:
    path = tmp_path / "zeros.csv"
    path.write_bytes(b"t,p,q,r\n" + bytes(8 << 20))
    with pytest.raises(LogError, match="no number|no usable row"):
        open_log(path)
    happened(5, "CSV whose second line is 8 MB of zeros: refused, there is no row in it")


def test_paths_that_are_no_logs(tmp_path: Path, happened: Happened) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    names = {
        "a loop of links": str(tmp_path / "loop"),
        "a pipe nobody writes": str(tmp_path / "pipe"),
        "an endless device": "/dev/zero",
        "a directory": str(tmp_path),
        "a NUL in the name": "a\x00b.csv",
        "a name of 5000 characters": "x" * 5000,
        "a process's memory": "/proc/self/mem",
        "nothing": "",
    }
    for path in names.values():
        with pytest.raises(LogError):
            open_log(path)
    happened(5, f"{', '.join(names)} given as log: each refused with its reason, none opened for long")


def test_round_trips_do_not_notice(tmp_path: Path) -> None:
    for write in (write_csv, write_tlog):
        write(tmp_path / "log", full_recording(1.0, 50.0))
        assert len(open_log(tmp_path / "log").channels) > 4
