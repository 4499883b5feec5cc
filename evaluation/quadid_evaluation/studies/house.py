"""Size of the house: lines and named numbers of every room, and the files that data cross on their way to a result.

python -m quadid_evaluation.studies.house  print all of it, and fail where a figure is above the recorded one
python -m quadid_evaluation.studies.house --record WHY  record today's figures with the reason for what rose
python -m quadid_evaluation.studies.house --no-walks    count only
"""

from __future__ import annotations

import ast
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

from quadid_evaluation.harness import options

if TYPE_CHECKING:
    from quadid.vehicle import Vehicle

Follow = AbstractContextManager[set[str] | None]

ROOT = Path(__file__).resolve().parents[3]
RECORDED = ROOT / "docs" / "results" / "house.json"
PRODUCT = {
    "quadid": "quadid",
    "replay": "replay/quadid_replay",
    "node": "quadid_node/quadid_node",
    "old names": "aliases",
}
EVALUATION = {"evaluation": "evaluation/quadid_evaluation"}
TESTS = {"tests": "tests", "node's tests": "quadid_node/test"}
DEEP = "quadid"
"""The room whose packages are listed one by one."""
SECONDS = 40.0
"""Length of the flight that is followed [s]: long enough for a published set."""
BATCH = 100
"""Messages that the node takes at a time."""
EPOCH = 1_700_000_000
"""UNIX time at which it begins [s]."""


class Size(NamedTuple):
    """Files, lines of Python and named numbers."""

    files: int
    lines: int
    numbers: int


def size(paths: Iterable[Path]) -> Size:
    """Size of some files, as on disk."""
    texts = [path.read_text(encoding="utf-8") for path in paths]
    lines, numbers = (len(text.splitlines()) for text in texts), (len(named_numbers(ast.parse(t))) for t in texts)
    return Size(len(texts), sum(lines), sum(numbers))


def count(root: Path = ROOT) -> dict[str, dict[str, int]]:
    """Lines of Python (`lines`) and named numbers (`numbers`) of product, evaluation and tests, as on disk."""
    groups = {"product": PRODUCT, "evaluation": EVALUATION, "tests": TESTS}
    sizes = {name: size(p for f in rooms.values() for p in (root / f).rglob("*.py")) for name, rooms in groups.items()}
    return {kind: {name: getattr(one, kind) for name, one in sizes.items()} for kind in ("lines", "numbers")}


def rooms(root: Path = ROOT) -> list[str]:
    """One line a room: files, lines, named numbers; the packages of the largest room below it."""
    rows: list[str] = []
    for label, folder in {**PRODUCT, **EVALUATION, **TESTS}.items():
        paths = sorted((root / folder).rglob("*.py"))
        parts: dict[str, list[Path]] = {label: paths}
        for path in paths if label == DEEP else ():
            first, *inner = path.relative_to(root / folder).parts
            parts.setdefault(f"  {first if inner else 'shared by all'}", []).append(path)
        for name, own in sorted(parts.items(), key=lambda part: (part[0] != label, part[0])):
            one = size(own)
            rows.append(f"{name:<24}{one.files:>6} files{one.lines:>8} lines{one.numbers:>6} numbers")
    return rows


def named_numbers(module: ast.Module) -> list[str]:
    """Names in capitals, leading underscore or not, that stand for numbers and other constants only."""
    out: list[str] = []
    for node in module.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        leaves = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant | ast.Call)]
        values = [n.value for n in leaves if isinstance(n, ast.Constant)]
        if leaves and len(values) == len(leaves) and all(type(value) in (int, float) for value in values):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            out += [n for n in names if n.isupper()]
    return out


def risen(now: dict[str, dict[str, int]], recorded: dict[str, dict[str, int]]) -> list[str]:
    """Figures above the recorded ones, a sentence each; those that nobody has recorded are none."""
    return [
        f"{kind} of {name}: {value}, recorded {recorded[kind][name]}"
        for kind, figures in now.items()
        for name, value in figures.items()
        if value > recorded.get(kind, {}).get(name, value)
    ]


def walks() -> dict[str, list[str]]:
    """Files that run between an IMU message of the ROS node and a parameter set, and between a log and its result.

    Functions that numba has compiled are not seen.
    """
    from quadid_replay import write_mcap

    import quadid
    from quadid.flight import fly

    vehicle = quadid.Vehicle.shipped("pelican")
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "flight.mcap"
        write_mcap(log, fly(vehicle, seconds=SECONDS, seed=5).recording, EPOCH * 10**9)
        out: dict[str, list[str]] = {}
        for follow in (nullcontext, _followed):  # the first time round kernels are compiled, which nobody is to watch
            with follow() as row:
                quadid.identify(log, vehicle=vehicle).to_json()
            message = _fly_through(log, vehicle, Path(folder), follow)
            out = {"imu message": sorted(message), "log row": sorted(row or ())}
        return out


def _fly_through(log: Path, vehicle: Vehicle, folder: Path, follow: Callable[[], Follow]) -> set[str]:
    """Gives the messages of a log to the service, as the node does, until a set is published; returns files crossed.

    What reads the log and opens service and history is not on a message's way.
    """
    from mcap_ros2._dynamic import generate_dynamic
    from quadid_node.history import Store
    from quadid_node.inputs import Decoder, Intake, SourceSelector, best_ranks, source
    from quadid_node.service import Service
    from quadid_node.worker import InlineWorker
    from quadid_replay.mcap_file import McapFile

    from quadid.online import SessionSettings
    from quadid_node import messages

    file, inputs = McapFile(log), {entry.topic: entry for entry in source("canonical").inputs}
    topics = file.topics
    stamps, chooser = [0.0], SourceSelector(best_ranks(tuple(inputs.values())))
    intake, arrived = Intake(lambda: stamps[0]), dict[str, list[bytes]]()
    for topic in topics.values():
        entry = inputs[topic.name]
        decode = generate_dynamic(topic.type, topic.definition)[topic.type]
        queue = arrived[topic.name] = []
        decoder = Decoder(entry, chooser, len(vehicle.rotors), decode)
        intake.open(entry, topic.name, decoder, lambda queue=queue: queue.pop(0) if queue else None)  # type: ignore[misc]
    service = Service(
        vehicle, SessionSettings(), InlineWorker(), Store(folder / f"{time.monotonic_ns()}.db", vehicle.name)
    )
    recorded = list(file.messages(topics.keys()))
    try:
        with follow() as crossed:
            for n, (number, nanoseconds, data) in enumerate(recorded):
                arrived[topics[number].name].append(data)
                if n % BATCH:
                    continue
                stamps[0] = nanoseconds * 1e-9 - EPOCH
                for block in intake.read(intake.take()):
                    service.push(block)
                for output in [o for _ in range(5) for o in service.step()]:
                    if output.topic == "parameters":
                        messages.RESULTS[output.topic].message(output, vehicle.name, service.boot_id)
                        return crossed or set()
    finally:
        service.close()
    raise RuntimeError(f"no set was published from {SECONDS:g} s of flight: nothing was followed to its end")


@contextmanager
def _followed() -> Iterator[set[str]]:
    """Collects the product's files whose functions are called within; imports do not count."""
    folders = tuple(f"{ROOT / folder}/" for folder in PRODUCT.values())
    files: set[str] = set()

    @cache
    def ours(filename: str) -> str:
        return str(Path(filename).relative_to(ROOT)) if filename.startswith(folders) else ""

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code.co_name != "<module>" and (name := ours(frame.f_code.co_filename)):
            files.add(name)

    sys.setprofile(note)
    threading.setprofile(note)
    try:
        yield files
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def main() -> int:
    """Command line; 1 where a figure rose."""
    given = options(__doc__, record="", no_walks=False)
    recorded = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.exists() else {}
    now = count()
    print(*rooms(), sep="\n")
    if not given.no_walks:
        followed = walks()
        now["files crossed"] = {name: len(files) for name, files in followed.items()}
        for name, files in followed.items():
            print(f"\n{name} crosses {len(files)} files:", *files)
    print()
    for kind, figures in now.items():
        print(f"{kind}: " + ", ".join(f"{name} {value}" for name, value in figures.items()))
    if given.record:
        RECORDED.write_text(json.dumps({**recorded, **now, "reason": given.record}, indent=1) + "\n", encoding="utf-8")
        return 0
    problems = risen(now, recorded)
    for problem in problems:
        print(
            f"risen: {problem}; remove as much, or say why: python -m quadid_evaluation.studies.house --record 'WHY'",
            file=sys.stderr,
        )
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
