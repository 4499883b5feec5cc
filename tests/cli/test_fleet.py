"""`quadid fleet` on a real local cluster: bad logs among good ones, going on, files that others read."""

import contextlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import dask
import pyarrow.parquet as pq
import pytest
from quadid_replay import write_csv, write_mcap

from quadid.app import fleet as fleet_cluster
from quadid.app.fleet import (
    PARTS,
    TABLES,
    ClusterError,
    Job,
    blank,
    cluster,
    find_jobs,
    identify_one,
    open_store,
    results,
)
from quadid.app.fleet_page import Row
from quadid.app.logs import OutputError, write_text
from quadid.errors import LogError, VehicleError
from quadid.flight import fly
from quadid.vehicle import Vehicle
from tests.commands import Cli, one_line
from tests.faults.evidence import Happened

DAY_NS = 86_400 * 10**9


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles with good flights, and everything that a folder of logs may hold beside them."""
    root = tmp_path_factory.mktemp("logs")
    pelican = Vehicle.shipped("pelican")
    for i in range(4):
        place = root / ("alpha" if i < 2 else "beta")
        place.mkdir(exist_ok=True)
        recording = fly(pelican, seconds=15.0, seed=40 + i).recording
        path = place / f"flight{i}.{'mcap' if i % 2 else 'csv'}"
        (write_mcap if i % 2 else write_csv)(path, recording)
        os.utime(path, ns=((100 + i) * DAY_NS, (100 + i) * DAY_NS))
    (root / "beta" / "vehicle.yaml").write_text(pelican.to_yaml(), encoding="utf-8")
    good = (root / "alpha" / "flight1.mcap").read_bytes()
    (root / "alpha" / "cut.mcap").write_bytes(good[:100])
    (root / "alpha" / "empty.bin").write_bytes(b"")
    (root / "alpha" / "noise.ulg").write_bytes(os.urandom(1000))
    (root / "README.txt").write_text("not a log", encoding="utf-8")
    write_csv(root / "alpha" / "short.csv", fly(pelican, seconds=1.0, seed=9).recording)
    return root


@pytest.fixture(scope="module")
def ran(quadid: Cli, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The result of one run over the folder."""
    out = tmp_path_factory.mktemp("out")
    run = quadid("fleet", folder, "--vehicle", "pelican", "--workers", "2", "--out", out, "--json", "-")
    assert run.code == 0, run.err
    return run.data, out


def test_bad_logs_cost_only_themselves(ran: tuple[dict[str, Any], Path]) -> None:
    result, _ = ran
    assert result["schema"] == "quadid.fleet/1"
    assert result["logs"] == result["worked"] == 8
    assert result["counts"]["done"] == 4
    assert sum(result["counts"].values()) == 8
    assert "failed" not in result["counts"]
    lost = {name for r in result["reasons"] for name in r["names"]}
    assert lost == {"alpha/cut.mcap", "alpha/empty.bin", "alpha/noise.ulg", "alpha/short.csv"}
    assert result["other_files"] == ["README.txt", "beta/vehicle.yaml"]


def test_every_vehicle_has_its_parameters(ran: tuple[dict[str, Any], Path]) -> None:
    result, _ = ran
    assert [u["unit"] for u in result["units"]] == ["alpha", "beta"]
    for unit in result["units"]:
        b = next(p for p in unit["parameters"] if p["parameter"] == "b")
        assert b["flights"] == 2
        assert b["median"] == pytest.approx(2.33e-5, rel=0.01)


def test_a_script_without_a_guard_gets_it_in_python_and_goes_on(folder: Path, tmp_path: Path) -> None:
    """Workers that start as others do run the script that starts them first."""
    (tmp_path / "logs").mkdir()
    shutil.copy(folder / "alpha" / "short.csv", tmp_path / "logs" / "short.csv")
    script = tmp_path / "script.py"
    script.write_text(
        "import json, quadid\nprint('once')\n"
        f"fleet = quadid.fleet({str(tmp_path / 'logs')!r}, {str(tmp_path / 'out')!r}, 'pelican', workers=1)\n"
        "print(json.dumps([fleet.result['worked'], fleet.to_frame()['status']['short.csv']]))\n"
        "assert __file__ and '__spec__' in globals()\n",
        encoding="utf-8",
    )
    for worked in (1, 0):
        run = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        first, answer = run.stdout.splitlines()
        assert (first, json.loads(answer)) == ("once", [worked, "refused"])


def test_sqlite_and_parquet_hold_the_same_rows(ran: tuple[dict[str, Any], Path]) -> None:
    _, out = ran
    connection = sqlite3.connect(out / "fleet.sqlite")
    for table in ("logs", "parameters", "findings"):
        (count,) = connection.execute(f"SELECT count(*) FROM {table}").fetchone()
        assert pq.read_table(out / f"fleet.{table}.parquet").num_rows == count
    connection.close()
    logs = {row["name"]: row for row in pq.read_table(out / "fleet.logs.parquet").to_pylist()}
    assert logs["alpha/flight1.mcap"]["mse_fitted"] < 1.3
    assert len(logs["alpha/flight1.mcap"]["sha256"]) == 64
    assert "empty file" in logs["alpha/empty.bin"]["reason"]


def test_a_second_run_does_only_what_is_new(
    quadid: Cli, folder: Path, ran: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    _, out = ran
    copy, own = tmp_path / "logs", tmp_path / "out"
    shutil.copytree(folder, copy)
    shutil.copytree(out, own)
    (copy / "alpha" / "noise.ulg").unlink()
    write_csv(copy / "alpha" / "new.csv", fly(Vehicle.shipped("pelican"), seconds=15.0, seed=50).recording)
    shutil.copy(copy / "alpha" / "flight0.csv", copy / "alpha" / "again.csv")
    run = quadid("fleet", copy, "--vehicle", "pelican", "--workers", "1", "--out", own, "--json", own / "r.json")
    assert run.code == 0, run.err
    result = json.loads((own / "r.json").read_text(encoding="utf-8"))
    assert (result["worked"], result["logs"]) == (1, 8)
    assert "1 of 8 logs worked on" in run.out
    assert "1 log is a copy of another and is not counted." in run.out
    assert "1 copy: the bytes of alpha/flight0.csv" in run.out
    page = (own / "fleet.html").read_text(encoding="utf-8")
    assert "noise.ulg" not in page
    assert "alpha/again.csv" in page
    b = next(p for p in result["units"][0]["parameters"] if p["parameter"] == "b")
    assert (result["units"][0]["logs"], b["flights"]) == (6, 3)
    assert result["copies"] == [{"log": "alpha/again.csv", "of": "alpha/flight0.csv"}]


def test_a_copy_under_another_name_is_one_flight(folder: Path, tmp_path: Path) -> None:
    """The file that was there first is counted, whatever it is called; empty files are no copies."""
    for name, day in (("b.csv", 1), ("a.csv", 2), ("sub/c.csv", 3), ("d.bin", 4), ("e.bin", 5)):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"" if name.endswith(".bin") else (folder / "alpha" / "flight0.csv").read_bytes())
        os.utime(path, ns=(day * DAY_NS, day * DAY_NS))
    found = find_jobs(tmp_path, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False)
    assert [job.name for job in found.jobs] == ["b.csv", "d.bin", "e.bin"]
    assert found.copies == (("a.csv", "b.csv"), ("sub/c.csv", "b.csv"))


def test_names_and_spans_are_read_as_by_every_command(folder: Path, tmp_path: Path) -> None:
    """A span cuts fit and trim alike; a file whose name looks like one with a span is that file."""
    text = Vehicle.shipped("pelican").to_yaml()
    shutil.copy(folder / "alpha" / "flight0.csv", tmp_path / "flight.csv@2:4")
    whole, job = (
        identify_one(Job(path, "a", "a", text, 1, 0, "", 50.0, 1, False))
        for path in (str(tmp_path / "flight.csv@2:4"), f"{folder}/alpha/flight0.csv@3:13")
    )
    assert (whole["status"], whole["seconds"]) == ("done", pytest.approx(15.0, abs=0.1))
    assert (job["status"], job["seconds"]) == ("done", pytest.approx(10.0, abs=0.1))
    spans = [json.loads(row["trims"][0]["trim"]) for row in (whole, job)]
    assert spans[0] != spans[1]


def test_outcomes_are_stored_as_they_come_so_that_a_killed_run_goes_on(folder: Path, tmp_path: Path) -> None:
    jobs = find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs
    empty = next(j for j in jobs if j.name.endswith("empty.bin"))
    with open_store(tmp_path / "fleet.sqlite") as store:
        store.put(identify_one(empty))
        with open_store(tmp_path / "fleet.sqlite") as other:  # before the first is closed
            assert other.ended() == {empty.name: (0, empty.modified, empty.key)}


def test_results_that_a_stranger_packed_beside_the_logs_are_forgotten(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    """Whoever made the folder knows names, sizes and times of its files, and not this user's secret."""
    text = Vehicle.shipped("pelican").to_yaml()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "stranger"))
    forged = next(j for j in find_jobs(folder, text, 50.0, 1, False).jobs if j.name.endswith("empty.bin"))
    row = {**identify_one(forged), "reason": "forged"}
    with open_store(tmp_path / "fleet.sqlite") as store:
        store.put(row)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "mine"))
    jobs = find_jobs(folder, text, 50.0, 1, False).jobs
    assert {j.key for j in jobs} == {j.key for j in find_jobs(folder, text, 50.0, 1, False).jobs}, (
        "a second run knows it"
    )
    with open_store(tmp_path / "fleet.sqlite") as store:
        for table in PARTS:
            store._connection.execute(f"INSERT INTO {table} (log) VALUES (NULL), ('none')")
        store.keep(jobs)
        assert not any(store.rows(table) for table in TABLES)
    happened(35, "fleet.sqlite packed beside the logs: its rows forgotten, the logs done")


@pytest.mark.parametrize("what", ["a view", "a trigger", "a pipe", "a link", "other results", "a folder", "text"])
def test_a_store_that_fleet_has_not_made_is_refused(tmp_path: Path, what: str, happened: Happened) -> None:
    path, other = tmp_path / "fleet.sqlite", tmp_path / "other"
    with contextlib.closing(sqlite3.connect(other)) as db, db:
        db.execute("CREATE TABLE mine (x)")
    kept = other.read_bytes()
    computes = {
        "a view": "CREATE VIEW logs AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x FROM c) SELECT x FROM c",
        "a trigger": "CREATE TABLE t (x); CREATE TRIGGER y AFTER INSERT ON t BEGIN DELETE FROM t; END",
    }
    if what in computes:
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.executescript(computes[what])
    elif what == "a pipe":
        os.mkfifo(path)
    elif what == "a link":
        path.symlink_to(other)
    elif what == "other results":  # by a second name
        other.unlink()
        with open_store(other) as store:
            store._connection.execute("INSERT INTO trims (log) VALUES ('x')")
            store._connection.commit()
        kept = other.read_bytes()
        os.link(other, path)
    elif what == "a folder":
        path.mkdir()
    else:
        path.write_text("no database" * 100)
    with pytest.raises(OutputError, match="cannot be used"), open_store(path):
        pass
    assert other.read_bytes() == kept
    happened(35, f"fleet.sqlite is {what}: refused")


def test_names_that_are_no_text_are_written_as_text(tmp_path: Path, happened: Happened) -> None:
    """One such file ended the whole fleet."""
    inner = tmp_path / os.fsdecode(b"in\xff")
    inner.mkdir()
    for number, name in enumerate((b"\xff.csv", b"\xfe.csv", b"a\x1b[31m\n.csv")):
        (inner / os.fsdecode(name)).write_text(f"t,p\n1,{number}\n")
    jobs = find_jobs(tmp_path, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs
    with open_store(tmp_path / "fleet.sqlite") as store:
        for job in jobs:
            store.put({**blank(job), "status": "unreadable", "reason": "x", "took": 0.0, "worker": 1})
        store.write_parquet(tmp_path)
        names = [row["name"] for row in store.rows("logs")]
    assert sorted(names) == ["in\\xff/\\xfe.csv", "in\\xff/\\xff.csv", "in\\xff/a\x1b[31m\n.csv"]
    assert {job.unit for job in jobs} == {"in\\xff"}
    happened(20, f"{len(names)} logs whose names are no text, or hold escapes: each its own row in SQLite and Parquet")


def test_a_link_where_results_are_written_is_replaced_and_not_followed(tmp_path: Path, happened: Happened) -> None:
    mine = tmp_path / "mine"
    mine.write_text("precious")
    out = tmp_path / "out"
    out.mkdir()
    for name in (*(f"fleet.{table}.parquet" for table in TABLES), "fleet.html", f".{os.getpid()}.fleet.html"):
        (out / name).symlink_to(mine)
    with open_store(out / "fleet.sqlite") as store:
        store.write_parquet(out)
    write_text(out / "fleet.html", "page")
    assert mine.read_text() == "precious"
    assert pq.read_table(out / "fleet.logs.parquet").num_rows == 0
    assert (out / "fleet.html").read_text() == "page"
    happened(35, "links under the names of results: replaced, what they pointed to untouched")


def test_files_of_which_nothing_is_stored_are_not_compared_byte_by_byte(tmp_path: Path, happened: Happened) -> None:
    """Two of a TiB each, a few KiB in an archive, were read to their end before any log."""
    for name in ("a.bin", "b.bin"):
        (tmp_path / name).touch()
        os.truncate(tmp_path / name, 64 << 20)
    found = find_jobs(tmp_path, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, diagnose=False)
    assert [job.name for job in found.jobs] == ["a.bin", "b.bin"]
    assert identify_one(found.jobs[0])["status"] == "unreadable"
    happened(35, "two equal files of which nothing is stored: not read to tell whether they are copies")


def test_folders_in_folders_without_end_cost_no_other_log(tmp_path: Path, happened: Happened) -> None:
    """A thousand of them ended the run, as did a path that is too long, or a folder that lets nobody look."""
    root = tmp_path / "logs"
    root.mkdir()
    here = os.open(root, os.O_RDONLY)
    for depth in range(1500):
        os.mkdir("in", dir_fd=here)
        inside = os.open("in", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inside
        if depth % 100 == 0 or depth > 1490:
            os.close(os.open("flight.bin", os.O_CREAT | os.O_WRONLY, dir_fd=here))
    os.close(here)
    found = find_jobs(root, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, diagnose=False)
    subprocess.run(["rm", "-rf", root], check=True)
    assert len(found.jobs) > 10
    assert any(name.endswith("/in") for name in found.others)
    happened(35, f"1,500 folders in each other: {len(found.jobs)} logs found, the rest among other files")


def test_folders_that_link_to_themselves_are_one_line(tmp_path: Path, quadid: Cli) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    run = quadid("fleet", tmp_path / "a", "--vehicle", "pelican", "--out", tmp_path / "out")
    assert run.code == 2
    assert "no folder" in run.err
    assert len(run.err.strip().splitlines()) == 1


def test_a_log_that_kills_its_worker_is_reported_and_the_rest_goes_on(folder: Path) -> None:
    jobs = find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs[:5]

    def deadly(job: Job) -> Row:
        import os

        if job.name.endswith("empty.bin"):
            os._exit(1)
        return {"name": job.name, "status": "done"}

    with cluster(None, 2, "1GiB") as client:
        rows = {row["name"]: row for row in results(client, jobs, deadly)}
    assert len(rows) == 5
    lost = [row for row in rows.values() if row["status"] != "done"]
    assert [row["name"] for row in lost] == ["alpha/empty.bin"]
    assert "workers died with this log" in lost[0]["reason"]


def test_workers_begin_warm_and_with_one_thread_each() -> None:
    def state() -> tuple[bool, int, str | None]:
        import os
        import sys

        warm = "quadid.identification.fit" in sys.modules
        return warm, sys.modules["numba"].config.NUMBA_NUM_THREADS, os.environ.get("OPENBLAS_NUM_THREADS")

    with cluster(None, 1, "1GiB") as client:
        assert list(client.run(state).values()) == [(True, 1, "1")]


def test_workers_killed_at_random_lose_no_log_and_do_none_twice(tmp_path: Path) -> None:
    """Four workers die in the middle of it; a log is worked on again only where its worker died with it."""
    jobs = [Job(str(tmp_path), f"flight{i}", "alpha", "", 0, 0, "", 50.0, 1, False) for i in range(40)]
    account = tmp_path / "account"

    def slow(job: Job) -> Row:
        import os
        import time

        time.sleep(0.2)
        with account.open("a") as file:
            file.write(f"{job.name}\n")
        return {"name": job.name, "status": "done", "worker": os.getpid()}

    rng = random.Random(7)
    rows = []
    with cluster(None, 2, "1GiB") as client:
        for row in results(client, jobs, slow):
            rows.append(row)
            if len(rows) in (3, 11, 17, 30):
                os.kill(rng.choice(list(client.run(os.getpid).values())), signal.SIGKILL)
    assert sorted(row["name"] for row in rows) == sorted(job.name for job in jobs)
    assert {row["status"] for row in rows} == {"done"}
    assert len({row["worker"] for row in rows}) > 2, "workers that died were replaced"
    finished = account.read_text().split()
    # One that was killed between its last line and the answer is done again, and only such a one.
    assert len(finished) - len(jobs) <= 4


CANNOT_WORK: dict[str, dict[str, Any]] = {
    "dead": {"distributed.worker.preload": ["no_such_module"]},
    "starved": {"distributed.worker.memory.pause": 0.01, "distributed.worker.memory.terminate": False},
}


@pytest.mark.parametrize("how", CANNOT_WORK)
def test_workers_that_cannot_start_are_an_error_and_leave_nothing_behind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, how: str
) -> None:
    """Their processes end at once, or take no work because their memory is full."""
    monkeypatch.setattr(fleet_cluster, "STARTING", 5.0)
    others = set(multiprocessing.active_children())
    jobs = [Job(str(tmp_path), f"flight{i}", "alpha", "", 0, 0, "", 50.0, 1, False) for i in range(4)]

    def slow(job: Job) -> Row:
        import time

        time.sleep(1.0)
        return {"name": job.name, "status": "done"}

    with (
        dask.config.set(CANNOT_WORK[how]),
        pytest.raises(ClusterError, match=r"no worker can start.*--memory"),
        cluster(None, 1, "1GiB") as client,
    ):
        list(results(client, jobs, slow))
    assert set(multiprocessing.active_children()) <= others


def test_a_cluster_that_is_already_there(folder: Path) -> None:
    from distributed import LocalCluster

    jobs = find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs[:2]
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as there,
        cluster(there.scheduler_address, None, "") as client,
    ):
        rows = list(results(client, jobs))
    assert {row["status"] for row in rows} <= {"done", "unreadable"}
    assert len(rows) == 2


def test_what_cannot_start_says_why(inside: Cli, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_cluster, "ANSWER", 0.5)
    one_line(inside("fleet", tmp_path / "absent", "--vehicle", "pelican", "--out", tmp_path), 2)
    (tmp_path / "bare").mkdir()
    with pytest.raises(LogError, match="no flight log below"):
        find_jobs(tmp_path / "bare", None, 50.0, 1, False)
    with pytest.raises(VehicleError, match=r"vehicle\.yaml"):
        find_jobs(folder, None, 50.0, 1, False)
    with pytest.raises(ClusterError, match="no Dask scheduler answers"), cluster("tcp://127.0.0.1:9", None, ""):
        pass
