"""`quadid replay`: drives the online session from a log, and writes what it would have published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from quadid_replay import TopicWriter

from quadid.app import options
from quadid.app.logs import written_whole
from quadid.app.outcome import Advance, Outcome, silent
from quadid.errors import QuadidError
from quadid.report.tables import Cell, TextTable, parameter_table

if TYPE_CHECKING:
    from quadid_node.messages import Output
    from quadid_node.service import Service

    from quadid.data.window import Recording


class ReplayError(QuadidError):
    """A replay that was asked for wrongly."""


def replay(
    log: Annotated[str, typer.Argument(metavar="LOG")],
    vehicle: options.VehicleName,
    speed: Annotated[str, typer.Option("--speed", metavar="1|max", help="Multiple of real time, or max.")] = "max",
    out: Annotated[Path | None, typer.Option(metavar="F.mcap")] = None,
    rate: options.Rate = 50.0,
    window: options.WindowSeconds = 10.0,
    refit: options.Refit = 1.0,
    diagnose: options.Diagnose = 60.0,
    approval: options.Approval = "auto",
    gate: options.Gate = "",
    as_recorded: Annotated[bool, typer.Option("--as-recorded")] = False,
    candidates: Annotated[bool, typer.Option("--candidates")] = False,
    seed: options.Seed = 0,
    preset: options.Preset = "auto",
    columns: options.Columns = None,
    *,
    advance: Advance = silent,
) -> Replayed:
    """Drive the online session from a log: the sets, findings and reasons that a live service would have published.

    Args:
        log: flight log: MCAP, .tlog, DataFlash, ULog, CSV. LOG@76:216: a span.
        out: write what would have been published.
        as_recorded: LOG was recorded by the node (record:=F.mcap): use its settings, start and order; repeats that
            run bit for bit.
        candidates: put every estimate into the JSON, not only the published sets.
    """
    from quadid_node.recording import arrivals, play, read_beginning, stream
    from quadid_node.service import Service, session_settings
    from quadid_node.worker import InlineWorker

    from quadid.app.kernels import FIT, prepare
    from quadid.app.logs import parse_columns, parse_part, read_log
    from quadid.cli import terminal
    from quadid.vehicle import Vehicle

    terminal.check_file(out, "--out")
    pace = _pace(speed)
    described = Vehicle.named(vehicle)
    settings = session_settings(
        approval, options.gate_settings(gate), rate=rate, window=window, refit=refit, diagnose=diagnose, seed=seed
    )
    cut = parse_part(log)
    if as_recorded and cut.path != Path(log):
        raise ReplayError(f"--as-recorded of {log}, a part", "whole recordings", f"--as-recorded {cut.path}")
    prepare(FIT, advance)
    advance(f"reading {cut.path.name}", 0.0)
    recording = cut.of(read_log(cut.path, preset, described, parse_columns(columns or [])))
    if as_recorded:
        beginning = read_beginning(Path(log))
        if beginning is None:
            raise ReplayError(f"{cut.path.name} was not recorded by the node", fix="leave --as-recorded out")
        if beginning.vehicle.name != described.name:
            whose = f"'{beginning.vehicle.name}', not '{described.name}'"
            raise ReplayError(f"{cut.path.name} was recorded of {whose}", fix="change --vehicle")
        described = beginning.vehicle
        service = Service(described, beginning.settings, InlineWorker(), restored=beginning.restored, live=False)
        blocks = arrivals(Path(log), beginning.source, len(described.rotors))
    else:
        service = Service(described, settings, InlineWorker(), live=False)
        blocks = stream(recording)
    rows = sum(len(c.t) for c in recording.channels.values())
    outputs = play(service, blocks, pace, lambda count: advance("replay", min(count / max(rows, 1), 1.0)))
    result = summary(recording, service, outputs, candidates)
    if out is not None:
        advance(f"writing {out.name}", 1.0)
        # What would have been published as MCAP: topics, types and stamps as of the live service
        from quadid_node.messages import RESULTS, TOPICS

        with written_whole(out.absolute()) as part, TopicWriter(part) as writer:
            for output in outputs:
                if output.topic in RESULTS:
                    message = RESULTS[output.topic].message(output, described.name, "")
                    stamp = message["header"]["stamp"]
                    writer.write(*TOPICS[output.topic], message, stamp["sec"] * 10**9 + stamp["nanosec"])
        result["out"] = str(out.absolute())
    return Replayed(result)


def _pace(speed: str) -> float:
    if speed == "max":
        return 0.0
    try:
        pace = float(speed)
    except ValueError as error:
        raise ReplayError(f"speed '{speed}'", "a factor of real time, or max", "for example --speed 1") from error
    if not 0.0 < pace <= 1000.0:
        raise ReplayError(f"speed {pace:g}", "more than 0, at most 1000, or max")
    return pace


def summary(
    recording: Recording, service: Service, outputs: Sequence[Output], candidates: bool = False
) -> dict[str, Any]:
    """The replay as JSON, of the form ``quadid.replay/1``; times [s, UNIX], or since boot in a log that has no more."""
    from quadid_node.messages import diagnosis_to_dict, set_to_dict, status_to_dict

    from quadid.app.logs import doubts_of
    from quadid.checks import inspect

    sets = [o.item for o in outputs if o.topic == "parameters"]
    estimates = [o.item for o in outputs if o.topic == "candidate"]
    refused: dict[str, int] = {}
    for item in estimates:
        if item.state.value == "rejected":
            refused[item.check] = refused.get(item.check, 0) + 1
    return {
        "schema": "quadid.replay/1",
        "log": recording.name,
        "epoch": 0,
        "vehicle": service.vehicle.name,
        "published": [set_to_dict(s) for s in sets],
        **({"candidates": [set_to_dict(s, covariance=False) for s in estimates]} if candidates else {}),
        "refused": refused,
        "diagnoses": [diagnosis_to_dict(o) for o in outputs if o.topic == "diagnosis"],
        "events": [dict(vars(o)) for o in outputs if o.topic == "event"],
        "status": status_to_dict(service.session.status()),
        "warnings": [*recording.warnings, *doubts_of(inspect(recording, service.vehicle).checks)],
    }


@dataclass(frozen=True, repr=False)
class Replayed(Outcome):
    """Outputs of a session: published, refused and found; `result` has the form ``quadid.replay/1``."""

    result: dict[str, Any]

    @property
    def opening(self) -> list[Cell]:
        """Events, estimates that were not published, and the last set, or why there is none."""
        result = self.result
        events = [e for e in result["events"] if e["level"] != "info" or e["kind"] == "accepted"]
        told = [f"{event['t'] or 0.0:9.1f} s  {event['text']}" for event in events]
        for check, count in result["refused"].items():
            told.append(f"{count} estimate{'s' * (count != 1)} not published: {check.replace('_', ' ')}")
        if result["published"]:
            last = result["published"][-1]
            about = f"from {last['stop'] - last['start']:.0f} s, reference: {last['reference']}"
            told.append(f"set {last['sequence']} of {result['vehicle']}, {about}")
        else:
            told.append(f"nothing published: {result['status']['phase']}: {result['status']['reason']}")
        return [Cell(text) for text in told]

    @property
    def failure(self) -> Exception | None:
        """The exit code 3 of a log that was played, but of which no set was published."""
        return None if self.result["published"] else typer.Exit(3)

    def tables(self) -> list[TextTable]:
        """The parameters of the last set."""
        return [parameter_table(self.result["published"][-1]["parameters"])] if self.result["published"] else []

    @property
    def sentences(self) -> list[Cell]:
        """Place to which it was written."""
        return [Cell(f"Written: {self.result['out']}")] if "out" in self.result else []
