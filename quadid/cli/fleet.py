"""`quadid fleet`: identifies a folder of logs in parallel, and says what they tell together."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app.logs import GRID, load_vehicle, parse_columns
from quadid.cli.options import Columns, JsonTarget, OutFolder, Rate, Seed

if TYPE_CHECKING:
    from quadid.app.fleet import Job
    from quadid.app.outcome import Advance
    from quadid.cli.fleet_run import Found, Store


def fleet(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of logs, formats auto-detected; one vehicle a folder.")
    ],
    vehicle: Annotated[
        str | None,
        typer.Option(
            "--vehicle", metavar="V", help="Shipped name or YAML file for folders without a vehicle.yaml of their own."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDR", help="A Dask scheduler (tcp://…); default: own workers."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", min=1, help="Own workers; default one a core.")
    ] = None,
    memory: Annotated[
        str, typer.Option("--memory", metavar="SIZE", help="Memory that one own worker may take.")
    ] = "2GiB",
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="Also name what the simulation gets wrong (slower).")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Identify all logs again, including those already done.")
    ] = False,
    rate: Rate = GRID,
    seed: Seed = 1,
    columns: Columns = None,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Identify every log of a folder on Dask; write SQLite, Parquet and a report. Run it again and it goes on."""
    from quadid.cli import fleet_run as fleet_folder
    from quadid.cli import terminal
    from quadid.cli.fleet_run import open_store

    terminal.check_file(json, "--json")
    target = terminal.out_folder(out)
    named = parse_columns(columns or [])
    if named and vehicle is None:
        raise typer.BadParameter(
            "vehicles in the folder name their own: give it with --vehicle", param_hint="--columns"
        )
    known = None if vehicle is None else load_vehicle(vehicle)
    default = None if known is None else known.model_copy(update={"columns": known.columns | named}).to_yaml()
    found = fleet_folder.find_jobs(folder.resolve(), default, rate, seed, diagnose, target)
    begin = time.perf_counter()
    with open_store(target / "fleet.sqlite") as store:
        store.keep({job.name for job in found.jobs})
        waiting = list(found.jobs) if again else outstanding(found.jobs, store)
        with terminal.progress() as advance:
            work(waiting, store, scheduler, workers, memory, advance)
        result = conclude(store, found, target, len(waiting), time.perf_counter() - begin)
    terminal.write_json(result, json)
    show(result, quiet=json == "-")


def outstanding(jobs: Sequence[Job], store: Store) -> list[Job]:
    """Jobs whose file, vehicle or settings differ from what the stored result was made from, or that have none."""
    ended = store.ended()
    return [job for job in jobs if ended.get(job.name) != (job.size, job.modified, job.key)]


def work(
    jobs: Sequence[Job], store: Store, scheduler: str | None, workers: int | None, memory: str, advance: Advance
) -> None:
    """Runs jobs and stores each outcome as it comes."""
    if not jobs:
        return
    from quadid.cli.fleet_run import cluster, results

    count = min(workers, len(jobs)) if workers is not None else None
    advance("start workers", 0.0)
    with cluster(scheduler, count, memory) as client:
        for done, row in enumerate(results(client, jobs), 1):
            store.put(row)
            advance(f"{done} of {len(jobs)} logs", done / len(jobs))


def conclude(store: Store, found: Found, target: Path, worked: int, seconds: float) -> dict[str, Any]:
    """Writes Parquet files and the report; returns the result as JSON has it."""
    from quadid.app.fleet import health_trend
    from quadid.app.outcome import provenance
    from quadid.cli import terminal
    from quadid.report.fleet import fleet_page, summarise
    from quadid.report.page import render

    logs, parameters, findings, trims = (store.rows(table) for table in ("logs", "parameters", "findings", "trims"))
    summary = summarise(logs, parameters, findings, found.copies)
    health = health_trend(logs, trims, {job.unit: job.vehicle for job in found.jobs})
    page = fleet_page(summary, logs, parameters, provenance([], terminal.command_line()), "Report of a fleet", health)
    files = [target / "fleet.sqlite", *store.write_parquet(target)]
    return {
        "schema": "quadid.fleet/1", "logs": len(logs), "worked": worked, "seconds": seconds, **summary,
        "health": health, "other_files": list(found.others), "files": [str(f) for f in files],
        "report": str(terminal.write_text(target / "fleet.html", render(page))),
    }  # fmt: skip


def show(result: dict[str, Any], quiet: bool) -> None:
    """Prints counts, vehicles, reasons of failures, and where the files are."""
    from quadid.cli import terminal
    from quadid.report.fleet import fleet_verdict
    from quadid.report.tables import Column, TextTable, number

    console = terminal.console(quiet)
    rows = []
    for unit in result["units"]:
        for i, p in enumerate(unit["parameters"] or [None]):
            head = (unit["unit"], str(unit["logs"]), str(unit["done"])) if i == 0 else ("", "", "")
            tail = ("", "", "", "") if p is None else (
                p["parameter"], number(p["median"]), p["unit"], f"{100 * p['spread']:.2g} %"
            )  # fmt: skip
            rows.append((*head, *tail))
    columns = (
        Column("vehicle"), Column("logs", right=True, rank=1), Column("answers", right=True, rank=2),
        Column("parameter"), Column("median", right=True), Column("unit"), Column("spread", right=True),
    )  # fmt: skip
    terminal.print_tables(console, [TextTable("Vehicles", columns, tuple(rows))])
    terminal.print_verdict(console, fleet_verdict(result, result["health"]))
    for reason in result["reasons"][:10]:
        console.print(f"{reason['logs']} {reason['status']}: {reason['reason']}", soft_wrap=True)
    console.print(f"{result['worked']} of {result['logs']} logs worked on in {result['seconds']:.1f} s")
    for file in (*result["files"], result["report"]):
        console.print(f"Written: {file}", soft_wrap=True)
