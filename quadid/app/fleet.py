"""Fleet: the logs of a folder identified in parallel on Dask, results on disk, and their summary."""

import contextlib
import hashlib
import hmac
import json
import logging
import multiprocessing
import os
import sqlite3
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import typer
from quadid_replay import open_log
from quadid_replay.formats import HEAD_BYTES, recognise
from quadid_replay.opening import stored_size

from quadid.app.fleet_page import Fleet, Row, health_trend, summarise
from quadid.app.logs import (
    GRID,
    OutputError,
    check_conventions,
    check_folder,
    on_grid,
    parse_part,
    require_gyro,
    written_whole,
)
from quadid.app.options import OUT, Described, NamedColumns, Rate, Seed, Typed, vehicle_if
from quadid.app.outcome import Advance, silent
from quadid.errors import LogError, NotIdentifiableError, QuadidError, VehicleError
from quadid.files import check_beside, read_regular
from quadid.sanitise import one_line
from quadid.vehicle import Vehicle
from quadid.version import __version__


def fleet(
    folder: Annotated[str | Path, Typed(Path, typer.Argument(metavar="DIR"), ...)],
    out: Annotated[str | Path, Typed(Path, OUT, Path())],
    vehicle: Annotated[Described | None, vehicle_if(", for folders without a vehicle.yaml.")] = None,
    *,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDR")] = None,
    workers: Annotated[int | None, typer.Option(metavar="N", min=1)] = None,
    memory: Annotated[str, typer.Option(metavar="SIZE")] = "2GiB",
    diagnose: Annotated[bool, typer.Option("--diagnose")] = False,
    again: Annotated[bool, typer.Option("--again")] = False,
    rate: Rate = GRID,
    seed: Seed = 1,
    columns: NamedColumns = None,
    advance: Advance = silent,
) -> Fleet:
    """Identifies every log of a folder in parallel on Dask; a second run continues where the first stopped.

    Rows of all logs and vehicles are written as SQLite and Parquet.

    Args:
        folder: folder of logs, formats auto-detected; a vehicle of the fleet is a folder, described by the nearest
            ``vehicle.yaml`` in it or above it.
        out: folder for ``fleet.sqlite`` and its tables as Parquet; made where it does not exist.
        vehicle: for folders without a ``vehicle.yaml``.
        scheduler: address of a Dask scheduler (``tcp://...``), whose workers see the logs at the same paths; by default
            own workers.
        workers: number of own workers; one a core by default.
        memory: memory that one own worker may take.
        diagnose: also name what the simulation gets wrong (slower).
        again: identify all logs again, including those already done.
        rate: of the uniform grid [Hz].
        seed: of all random numbers.
        columns: what a CSV calls a column, by its name in the contract; needs `vehicle`.
        advance: called with the stage and the share done.

    Returns:
        Rows of logs, parameters of every vehicle, drifts, health of every vehicle against its first flights.

    Raises:
        LogError: no such folder, or no log in it.
        VehicleError: a log without a vehicle.
        ClusterError: nothing answers at `scheduler`, or no worker can start.
    """
    if columns and vehicle is None:
        raise VehicleError("columns without a vehicle", "columns of the vehicle that is given", "give vehicle, too")
    default = None
    if vehicle is not None:
        known = Vehicle.named(vehicle)
        default = known.model_copy(update={"columns": {**known.columns, **(columns or {})}}).to_yaml()
    target = Path(os.path.realpath(out))
    check_folder(target, "out", "fleet.*.parquet")
    found = find_jobs(Path(os.path.realpath(folder)), default, rate, seed, diagnose, target)
    begin = time.perf_counter()
    with open_store(target / "fleet.sqlite") as store:
        store.keep(found.jobs)
        # Not again: those whose file, vehicle and settings are what the stored result was made from.
        ended = {} if again else store.ended()
        waiting = [job for job in found.jobs if ended.get(job.name) != (job.size, job.modified, job.key)]
        if waiting:
            advance("start workers", 0.0)
            count = min(workers, len(waiting)) if workers is not None else None
            with cluster(scheduler, count, memory) as client:
                for done, row in enumerate(results(client, waiting), 1):
                    store.put(row)
                    advance(f"{done} of {len(waiting)} logs", done / len(waiting))
        logs, parameters, findings, trims = (store.rows(table) for table in ("logs", "parameters", "findings", "trims"))
        files = [target / "fleet.sqlite", *store.write_parquet(target)]
    result = {
        "schema": "quadid.fleet/1",
        "logs": len(logs),
        "worked": len(waiting),
        "seconds": time.perf_counter() - begin,
        **summarise(logs, parameters, findings, found.copies),
        "health": health_trend(logs, trims, {job.unit: job.vehicle for job in found.jobs}),
        "other_files": list(found.others),
        "files": [str(file) for file in files],
    }
    return Fleet(result, logs, parameters)


# --- What is done to one log of a fleet, wherever a worker runs: plain data in, plain data out, never an exception


EARLIEST = 946_684_800.0
"""Times before the year 2000 are seconds since boot, not dates [s]."""
_VALUE = ("unit", "value", "low", "high")


@dataclass(frozen=True)
class Job:
    """One log to identify.

    Attributes:
        path: absolute, with a span if wanted; every worker must see it there.
        name: relative to the folder of the fleet.
        unit: which vehicle of the fleet it belongs to.
        size, modified: of the file [bytes], [ns]; with `key` they decide whether a stored result is still good.
        key: hash of everything else that decides the result.
        rate: of the grid [Hz]; seed: of the search; diagnose: name what the simulation gets wrong too.
    """

    path: str
    name: str
    unit: str
    vehicle: str
    size: int
    modified: int
    key: str
    rate: float
    seed: int
    diagnose: bool


def identify_one(job: Job) -> Row:
    """Identifies one log.

    Returns:
        ``status`` ``done``, ``refused`` (the data cannot support an answer), ``unreadable`` or ``failed`` (a defect
        of this program), ``reason``, and what was found; nothing is raised, so that no log can stop the others.
    """
    begin = time.perf_counter()
    row = blank(job)
    try:
        _identify(job, row)
        row |= {"status": "done", "reason": ""}
    except (QuadidError, OSError) as error:
        # What shows its trim has been read.
        unusable = isinstance(error, NotIdentifiableError) or row["trims"]
        row |= {"status": "refused" if unusable else "unreadable", "reason": one_line(str(error), 500)}
    except Exception as error:  # noqa: BLE001 - one log's defect is reported in its row and must not stop the rest
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {one_line(str(error), 500)}"}
    return {**row, "took": time.perf_counter() - begin, "worker": os.getpid()}


def blank(job: Job) -> Row:
    """The row of a log of which nothing is known yet but its file."""
    empty: Row = dict.fromkeys(TABLES["logs"]) | {part: [] for part in (*PARTS, "warnings")}
    known = ("name", "unit", "size", "modified", "key")
    return empty | {key: getattr(job, key) for key in known} | {"started": 1e-9 * job.modified, "dated_by": "file"}


def _identify(job: Job, row: Row) -> None:
    """Adds to the row of a log what is found, step by step: what was found before an error stays in it."""
    from quadid.app.diagnose import diagnose
    from quadid.app.identify import identify
    from quadid.condition.trim import flight_to_dict, flight_trim

    cut, vehicle = parse_part(job.path), Vehicle.from_yaml(job.vehicle, job.unit)
    recording = open_log(cut.path, columns=vehicle.columns)
    checked = check_conventions(recording, vehicle, cut)
    # Facts of the flight, whether or not anything can be fitted to it.
    flown = cut.of(recording)
    row |= {"vehicle": vehicle.name, "sha256": flown.sha256, "format": flown.format}
    row["warnings"] += [f"{flown.name}: {text}" for text in (*flown.warnings, *checked.doubts)]
    if (first := flown.span[0]) > EARLIEST:  # the log has a date
        row |= {"started": first, "dated_by": "log"}
    # Its trim, where it flew steadily.
    try:
        row["trims"] = [{"trim": json.dumps(flight_to_dict(flight_trim(flown, vehicle)))}]
    except NotIdentifiableError as error:
        row["warnings"].append(f"no trim: {error.found}")
    # Its parameters, and what the simulation gets wrong.
    require_gyro(recording)
    log = on_grid(cut.path, recording, vehicle, job.rate, cut, checked)
    row |= {"seconds": log.grid.seconds_used, "warnings": list(dict.fromkeys([*row["warnings"], *log.warnings]))}
    found = identify(log, seed=job.seed)
    named = [{"parameter": r["name"], **{k: r[k] for k in (*_VALUE, "status")}} for r in found.records()]
    causes: Row = {}
    if job.diagnose:
        done = diagnose(log, seed=job.seed)
        kept = ("effect", "confident", "parameter", *_VALUE, "mse_before", "mse_after")
        causes = {"verdict": done.result["verdict"], "findings": [{k: r[k] for k in kept} for r in done.records()]}
    errors = found.result["sets"][0]["mse"]
    row |= {"mse_initial": errors["initial"], "mse_fitted": errors["fitted"], "parameters": named, **causes}


# --- Jobs on Dask: an embedded cluster of processes, or one that is already there


AHEAD = 4
"""Jobs handed out for each worker, so that the scheduler's memory does not grow with the number of logs."""
ATTEMPTS = 4
"""Workers that may die with a log before it is given up; workers also die for reasons that are not the log's."""
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}

_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "500ms",
}
"""Dask otherwise looks at every worker's stack each 10 ms, at itself each 20 ms and at memory each 100 ms."""
_WARM = (
    "distributed",
    "distributed.nanny",
    "quadid.app.fleet",
    "quadid.app.identify",
    "quadid.identification.fit",
    "quadid.condition.trim",
    "quadid_replay.rosbag",
)
"""Modules imported by the process from which all workers are forked, those that replace dead ones too."""

STARTING = 180.0
"""Time that a worker may take to start [s]: when none lives for so long, there is no cluster."""
ANSWER = 10.0
"""Time that a scheduler may take to answer [s]."""
_LOOK = 2.0
"""A worker lives when it is there at two looks, so far apart [s]."""


class ClusterError(QuadidError):
    """No cluster to work on."""


@contextmanager
def cluster(address: str | None, workers: int | None, memory: str) -> Iterator[Any]:
    """A client of the cluster at `address`, or of an embedded one that ends with the block.

    Args:
        address: of a Dask scheduler, for example ``tcp://10.0.0.1:8786``; its workers must see the logs at the same
            paths and have quadid of the same version.
        workers: processes of the embedded cluster; None for one a core.
        memory: that one worker may take before it is restarted and its log given up, for example ``2GiB``.

    Raises:
        ClusterError: nothing answers at the address, or no worker can start.
    """
    import dask
    from distributed import Client, LocalCluster
    from distributed.utils import get_mp_context

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
        "distributed.scheduler.worker-ttl": None,  # a worker that compiles kernels is silent for minutes
        "distributed.worker.multiprocessing-method": "forkserver",
    }
    private = TemporaryDirectory(dir=dask.config.get("temporary-directory"), ignore_cleanup_errors=True)
    with private, dask.config.set({**settings, **_QUIET, "temporary-directory": private.name}), _program_unseen():
        if address is not None:
            try:
                client = Client(address, timeout=ANSWER, set_as_default=False)
            except (OSError, TimeoutError, ValueError) as error:
                raise ClusterError(
                    f"no Dask scheduler answers at {address}",
                    "an address such as tcp://10.0.0.1:8786",
                    "start one with `dask scheduler`, or leave --scheduler out",
                ) from error
            with client:
                yield client
            return
        get_mp_context().set_forkserver_preload(list(_WARM))
        count, others = workers or os.cpu_count() or 1, set(multiprocessing.active_children())
        try:
            own = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                memory_limit=memory,
                dashboard_address=None,
                host="127.0.0.1",
                silence_logs=logging.CRITICAL,
                death_timeout=STARTING,
            )
        except (RuntimeError, OSError, TimeoutError) as error:
            raise _no_worker(f"their processes end at once or not within {STARTING:g} s") from error
        try:
            with Client(own, set_as_default=False) as client:
                yield client
        finally:
            from distributed.core import Status

            try:
                own.close(timeout=STARTING)
            except (AssertionError, TimeoutError):
                # Dask cannot close a cluster while the worker that replaces a dead one starts, and fails; its process
                # is then killed, and it can.
                for child in set(multiprocessing.active_children()) - others:
                    child.kill()
                own.status = Status.failed  # is closed once more
                own.close(timeout=STARTING)


@contextmanager
def _program_unseen() -> Iterator[None]:
    """Keeps processes that start from running the caller's script first, which would start more of them.

    They import from the folders that this process does, but not from the one it stands in (notebooks, ``python -c``).
    """
    main, path = vars(sys.modules["__main__"]), sys.path[:]
    named = [*filter(None, path)]
    kept: dict[str, Any] = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    main.update({"__file__": None, "__spec__": None})
    sys.path[:] = named[1:] if named[0] == os.getcwd() else named
    try:
        yield
    finally:
        sys.path[:] = path
        del main["__file__"], main["__spec__"]
        main.update(kept)


def results(client: Any, jobs: Sequence[Job], work: Callable[[Job], Row] = identify_one) -> Iterator[Row]:
    """Runs `work` on all jobs and yields one row of each as it is ready, whichever workers die on the way.

    A log whose workers die `ATTEMPTS` times, the last time with nothing else in them, costs that log only.

    Raises:
        ClusterError: no worker lives for `STARTING` seconds.
    """
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    threads = sum(client.nthreads().values())
    if threads == 0:
        raise ClusterError("the cluster has no workers", "at least one", "start one with `dask worker ADDRESS`")
    # A dying worker takes along jobs that waited in it.  So these come again, as many as there are workers, and at last
    # one by one, where only a log that kills its worker is lost.
    for ahead in (AHEAD * threads, *[threads] * (ATTEMPTS - 2), 1):
        waiting, running, ended, died = iter(jobs), dict[str, Job](), SimpleQueue[Any](), list[Job]()
        following = list(islice(waiting, ahead))
        while following or running:
            for job in following:
                future = client.submit(work, job, pure=False, retries=0)
                running[future.key] = job
                future.add_done_callback(ended.put)
            future = _next_of(ended, client)
            job, following = running.pop(future.key), list(islice(waiting, 1))
            try:
                row = dict(future.result()) if future.status == "finished" else None
            except (KilledWorker, FutureCancelledError):  # also where it dies before the result is fetched
                row = None
            if row is None:
                died.append(job)
            else:
                yield row
        jobs = died
    reason = f"{ATTEMPTS} workers died with this log: too much memory (see --memory), or a crash in a library"
    yield from ({**blank(job), "status": "failed", "reason": reason} for job in jobs)


def _next_of(ended: SimpleQueue[Any], client: Any) -> Any:
    """The next future that ends."""
    lived, before = time.monotonic(), set[str]()
    while True:
        with contextlib.suppress(Empty):
            return ended.get(timeout=_LOOK)
        there = set(client.sync(client.scheduler.ncores_running))
        if there & before:
            lived = time.monotonic()
        elif time.monotonic() - lived > STARTING:
            raise _no_worker(f"none lived for {_LOOK:g} s in the last {STARTING:g} s")
        before = there


def _no_worker(how: str) -> ClusterError:
    return ClusterError(
        f"no worker can start: {how}",
        "at least one worker with memory for one log",
        "use more --memory, or fewer --workers; finished logs are kept",
    )


# --- The logs of a folder, and which vehicle of the fleet each belongs to


VEHICLE_FILE = "vehicle.yaml"
SUFFIXES = (".mcap", ".tlog", ".bin", ".ulg")
"""Suffixes of logs: such a file is tried, and its refusal reported, even if its content is not recognised."""


class Found(NamedTuple):
    """Logs of a folder as jobs, files that are no logs, and logs with the bytes of a job's (name of copy and job)."""

    jobs: tuple[Job, ...]
    others: tuple[str, ...]
    copies: tuple[tuple[str, str], ...]


def find_jobs(
    root: Path, default: str | None, rate: float, seed: int, diagnose: bool, leave_out: Path | None = None
) -> Found:
    """Lists all logs below `root`, recognised by content.

    The vehicle of a log is described by the nearest ``vehicle.yaml`` in its folder or above it, up to `root`, else by
    `default`.  A vehicle of the fleet is a folder: logs of one folder belong to the same one.  Logs with the same bytes
    are one flight, and one job.

    Args:
        root: folder.
        default: text of the vehicle file for folders without one.
        rate: of the grid [Hz].
        seed: of the search.
        diagnose: name what the simulation gets wrong, too.
        leave_out: folder that is not looked into, for the results.

    Raises:
        LogError: no folder, or no log in it.
        VehicleError: a log without a vehicle.
    """
    if not root.is_dir():
        fix = "name the folder that it is in" if root.exists() else "check the path"
        raise LogError(f"no folder {root}", "a folder with flight logs", fix)
    jobs, others, secret = list[Job](), list[str](), _secret()
    read: Callable[[Path], Vehicle] = cache(Vehicle.named)
    for path in _files(root, leave_out):
        name, folder = (
            # As every database and page can hold it.
            os.fsencode(p.relative_to(root).as_posix()).decode(errors="backslashreplace")
            for p in (path, path.parent)
        )
        try:
            status = path.stat() if _is_log(path) else None
        except OSError:  # its folder does not let us, or its path is too long
            status = None
        if status is None:
            others.append(name)
            continue
        above = (place / VEHICLE_FILE for place in path.parents if place.is_relative_to(root))
        file = next((file for file in above if file.is_file()), None)
        if file is None and default is None:
            need, fix = f"a {VEHICLE_FILE} in that folder or above it", "add one, or give --vehicle"
            raise VehicleError(f"no vehicle for {path.parent}", need, fix)
        text = default or "" if file is None else read(file).to_yaml()
        unit = Vehicle.from_yaml(text).name if folder == "." else folder
        size, modified = status.st_size, status.st_mtime_ns
        made_from = f"{name}\0{size} {modified} {rate!r} {seed} {diagnose} {__version__}\0{text}"
        key = hmac.new(secret, made_from.encode(errors="replace"), "sha256").hexdigest()[:32]
        jobs.append(Job(str(path), name, unit, text, size, modified, key, rate, seed, diagnose))
    if not jobs:
        raise LogError(f"no flight log below {root} ({len(others)} other files)", "MCAP, tlog, DataFlash, ULog or CSV")
    copies = _copies(jobs)
    return Found(tuple(job for job in jobs if job.name not in copies), tuple(others), tuple(sorted(copies.items())))


def _secret() -> bytes:
    """Random bytes of this user: results that somebody packed beside the logs are not taken for ours without them.

    Where they cannot be kept, every run has its own, and does every log.
    """
    path = Path(os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share"), "quadid", "fleet.key")
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
                file.write(os.urandom(32))
        return read_regular(path, 32)
    except OSError:
        return os.urandom(32)


def _copies(jobs: Sequence[Job]) -> dict[str, str]:
    """Logs with the bytes of another, and which: the file that was changed first, as a copy may have a later date."""
    sizes = Counter(job.size for job in jobs)
    first: dict[bytes, str] = {}
    out = {}
    for job in sorted(jobs, key=lambda job: (job.modified, job.name)):
        if not job.size or sizes[job.size] < 2:
            continue
        try:
            stored_size(Path(job.path))
            with open(job.path, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").digest()
        except (OSError, LogError):
            continue  # its row has the reason
        if first.setdefault(digest, job.name) != job.name:
            out[job.name] = first[digest]
    return out


def _files(root: Path, leave_out: Path | None) -> Iterator[Path]:
    """Files below a folder, those of a folder before those of the folders in it; also what cannot be looked at."""
    waiting = [root]
    while waiting:
        here, inner = waiting.pop(), list[Path]()
        try:
            names = sorted(os.listdir(here))
        except OSError:
            yield here
            continue
        for path in (here / name for name in names if not name.startswith(".")):
            if os.path.isdir(path):
                inner += [path] * (path != leave_out and not os.path.islink(path))
            # Results beside the logs: `--out` may be the folder itself.
            elif not path.name.startswith("fleet.") and (os.path.isfile(path) or not os.path.lexists(path)):
                yield path
        waiting += reversed(inner)


def _is_log(path: Path) -> bool:
    if path.suffix.lower() in SUFFIXES:
        return True
    try:
        with path.open("rb") as file:
            recognise(file.read(HEAD_BYTES), path.name)
    except OSError:
        return True  # its row has the reason
    except LogError:
        return path.suffix.lower() == ".csv"
    return True


# --- Results of a fleet on disk: SQLite while it runs, so that a stopped run goes on where it was; Parquet at its end


_FOUND = "parameter TEXT, unit TEXT, value REAL, low REAL, high REAL"
TABLES: dict[str, dict[str, str]] = {
    table: dict(column.split(" ", 1) for column in columns.split(", "))
    for table, columns in {
        "logs": "name TEXT PRIMARY KEY, unit TEXT, vehicle TEXT, status TEXT, reason TEXT, started REAL, "
        "dated_by TEXT, format TEXT, seconds REAL, mse_initial REAL, mse_fitted REAL, verdict TEXT, size INTEGER, "
        "modified INTEGER, sha256 TEXT, key TEXT, took REAL, warnings TEXT",
        "parameters": f"log TEXT, {_FOUND}, status TEXT",
        "findings": f"log TEXT, effect TEXT, confident INTEGER, {_FOUND}, mse_before REAL, mse_after REAL",
        "trims": "log TEXT, trim TEXT",
    }.items()
}
"""Columns of each table with their kinds: times in [s], started since 1970, size in bytes, modified in ns; the trim of
a flight as JSON, for the comparison with other flights of its vehicle."""
PARTS = ("parameters", "findings", "trims")
"""Tables with rows of a log."""
_NAMES = {table: ", ".join(f'"{name}"' for name in kinds) for table, kinds in TABLES.items()}
_KINDS = {table: ", ".join(f'"{name}" {kind}' for name, kind in kinds.items()) for table, kinds in TABLES.items()}
SCHEMA = "".join(
    [
        *(f"CREATE TABLE IF NOT EXISTS {table} ({kinds});" for table, kinds in _KINDS.items()),
        *(f"CREATE INDEX IF NOT EXISTS {table}_log ON {table} (log);" for table in PARTS),
    ]
)
ENDED = ("done", "refused", "unreadable")
"""Outcomes that the same file would have again."""


class Store:
    """The results of one fleet; every log is written in one transaction as it arrives."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        """Makes the tables; raises sqlite3.DatabaseError for a file that is none, or holds what computes."""
        self._connection = connection
        connection.execute("PRAGMA trusted_schema = OFF")
        whole = "SELECT type, name, sql FROM sqlite_master"
        with contextlib.closing(sqlite3.connect(":memory:")) as made:
            made.executescript(SCHEMA)
            ours = set(made.execute(whole))
        if strange := {name for kind, name, sql in connection.execute(whole) if (kind, name, sql) not in ours}:
            raise sqlite3.DatabaseError(f"{one_line(str(min(strange)))} in it is not as `fleet` makes it")
        connection.execute("PRAGMA journal_mode=WAL")
        connection.executescript(SCHEMA)

    def ended(self) -> dict[str, tuple[int, int, str]]:
        """Logs that need not be done again: size, time of change and key by name."""
        marks = ", ".join("?" * len(ENDED))
        found = self._connection.execute(f"SELECT name, size, modified, key FROM logs WHERE status IN ({marks})", ENDED)
        return {name: (size, modified, key) for name, size, modified, key in found}

    def put(self, row: Mapping[str, Any]) -> None:
        """Writes one log's outcome in place of an older one."""
        name, warnings = row["name"], json.dumps(row["warnings"], ensure_ascii=False)
        parts = {table: [{"log": name, **part} for part in row[table]] for table in PARTS}
        with self._connection:
            for table, rows in {**parts, "logs": [{**row, "warnings": warnings}]}.items():
                column, values = _name_column(table), [[one[c] for c in TABLES[table]] for one in rows]
                marks = ", ".join("?" * len(TABLES[table]))
                self._connection.execute(f"DELETE FROM {table} WHERE {column} = ?", (name,))
                self._connection.executemany(f"INSERT INTO {table} ({_NAMES[table]}) VALUES ({marks})", values)

    def keep(self, jobs: Sequence[Job]) -> None:
        """Forgets all that is not a result of one of these jobs: of other files, settings or authors."""
        ours = {(job.name, job.size, job.modified, job.key) for job in jobs}
        found = self._connection.execute("SELECT rowid, name, size, modified, key FROM logs")
        gone = [(row,) for row, *known in found if tuple(known) not in ours]
        with self._connection:
            self._connection.executemany("DELETE FROM logs WHERE rowid = ?", gone)
            for table in PARTS:
                self._connection.execute(f"DELETE FROM {table} WHERE log IS NULL OR log NOT IN (SELECT name FROM logs)")

    def rows(self, table: str) -> list[Row]:
        """All rows of a table, in the order of their log's name."""
        order = f"ORDER BY {_name_column(table)}, rowid"
        found = self._connection.execute(f"SELECT {_NAMES[table]} FROM {table} {order}")
        return [dict(zip(TABLES[table], values, strict=True)) for values in found]

    def write_parquet(self, folder: Path) -> list[Path]:
        """Writes every table as a Parquet file that pandas, polars, DuckDB and Spark read; returns their paths."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        kinds = {"TEXT": pa.string(), "REAL": pa.float64(), "INTEGER": pa.int64()}
        files = []
        for table, columns in TABLES.items():
            schema = pa.schema([(name, kinds[kind.split()[0]]) for name, kind in columns.items()])
            files.append(folder / f"fleet.{table}.parquet")
            with written_whole(files[-1]) as part:
                pq.write_table(pa.Table.from_pylist(self.rows(table), schema=schema), part, compression="zstd")
        return files


def _name_column(table: str) -> str:
    return "name" if table == "logs" else "log"


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """Opens or makes the SQLite file; raises OutputError for one that `fleet` has not made, or that fails."""
    check_beside(path)
    try:
        if path.is_symlink() or (path.exists() and (not path.is_file() or path.stat().st_nlink > 1)):
            raise sqlite3.DatabaseError("it is no regular file, or has a second name")
        with contextlib.closing(sqlite3.connect(path)) as connection:
            yield Store(connection)
    except sqlite3.Error as error:
        fix = "remove it or free space, or use another --out"
        raise OutputError(f"{path} cannot be used ({error})", "results of `fleet`", fix) from error
