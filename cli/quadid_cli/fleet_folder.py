"""The logs of a folder, and which vehicle of the fleet each belongs to."""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from quadid_workflow.fleet import Job

from quadid.errors import LogError, VehicleError

VEHICLE_FILE = "vehicle.yaml"
SUFFIXES = (".mcap", ".tlog", ".bin", ".ulg")
"""What is called like a log is tried, and its refusal reported, even if its content is not recognised."""


@dataclass(frozen=True)
class Found:
    """Logs of a folder as jobs, files that are no logs, and logs with the bytes of a job's (name of copy and job)."""

    jobs: tuple[Job, ...]
    others: tuple[str, ...]
    copies: tuple[tuple[str, str], ...] = ()


def find_jobs(
    root: Path, default: str | None, rate: float, seed: int, diagnose: bool, leave_out: Path | None = None
) -> Found:
    """Lists all logs below `root`, recognised by content.

    The vehicle of a log is described by the nearest ``vehicle.yaml`` in its folder or above it, up to `root`, else by
    `default`.  A vehicle of the fleet is a folder: logs of one folder belong to the same one.  Logs with the same bytes
    are one flight, and one job.

    Args:
        root: folder of the fleet.
        default: text of the vehicle file for folders without one.
        rate: of the grid [Hz].
        seed: of all searches.
        diagnose: whether to diagnose, too.
        leave_out: folder that is not looked into, for the results.

    Raises:
        LogError: no folder, or no log in it.
        VehicleError: a log without a vehicle.
    """
    if not root.is_dir():
        raise LogError(f"no folder {root}", "a folder with flight logs", "check the path")
    jobs, others, texts = list[Job](), list[str](), dict[Path, str]()
    for path in _files(root, leave_out):
        name = path.relative_to(root).as_posix()
        if not _is_log(path):
            others.append(name)
            continue
        text = _vehicle_text(path.parent, root, default, texts)
        folder = path.parent.relative_to(root).as_posix()
        status = path.stat()
        jobs.append(Job(
            str(path), name, _vehicle_name(text, folder), text, status.st_size, status.st_mtime_ns,
            _key(text, rate, seed, diagnose), rate, seed, diagnose,
        ))  # fmt: skip
    if not jobs:
        raise LogError(f"no flight log below {root} ({len(others)} other files)", "MCAP, tlog, DataFlash, ULog or CSV")
    copies = _copies(jobs)
    return Found(tuple(job for job in jobs if job.name not in copies), tuple(others), tuple(copies.items()))


def _copies(jobs: Sequence[Job]) -> dict[str, str]:
    """Logs with the bytes of another, and which: the file that was changed first, as a copy may have a later date."""
    same_size: dict[int, list[Job]] = defaultdict(list)
    for job in sorted(jobs, key=lambda job: (job.modified, job.name)):
        same_size[job.size].append(job)
    first: dict[bytes, str] = {}
    out = {}
    for job in (job for some in same_size.values() if len(some) > 1 for job in some if job.size):
        try:
            with open(job.path, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").digest()
        except OSError:
            continue  # its row says why it cannot be read
        if first.setdefault(digest, job.name) != job.name:
            out[job.name] = first[digest]
    return dict(sorted(out.items()))


def _files(root: Path, leave_out: Path | None) -> Iterator[Path]:
    for folder, inner, names in os.walk(root):
        here = Path(folder)
        inner[:] = sorted(n for n in inner if not n.startswith(".") and here / n != leave_out)
        for name in sorted(names):
            # Results beside the logs: `--out` may be the folder itself.
            if not name.startswith((".", "fleet.")) and (here / name).is_file():
                yield here / name


def _is_log(path: Path) -> bool:
    from quadid_replay.recognise import HEAD_BYTES, recognise

    if path.suffix.lower() in SUFFIXES:
        return True
    try:
        with path.open("rb") as file:
            recognise(file.read(HEAD_BYTES), path.name)
    except OSError:
        return True  # its row says why it cannot be read
    except LogError:
        return path.suffix.lower() == ".csv"
    return True


def _vehicle_text(folder: Path, root: Path, default: str | None, texts: dict[Path, str]) -> str:
    for place in (folder, *folder.parents):
        file = place / VEHICLE_FILE
        if file in texts:
            return texts[file]
        if file.is_file():
            from quadid_workflow.loading import load_vehicle

            texts[file] = load_vehicle(str(file)).to_yaml()
            return texts[file]
        if place == root:
            break
    if default is None:
        raise VehicleError(
            f"no vehicle for {folder}", f"a {VEHICLE_FILE} in that folder or above it", "add one, or give --vehicle"
        )
    return default


@lru_cache(maxsize=64)
def _vehicle_name(text: str, folder: str) -> str:
    from quadid.vehicle import Vehicle

    return Vehicle.from_yaml(text).name if folder == "." else folder


def _key(vehicle: str, rate: float, seed: int, diagnose: bool) -> str:
    from quadid import __version__

    parts = (vehicle, f"{rate!r}", str(seed), str(diagnose), __version__)
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
