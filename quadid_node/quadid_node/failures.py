"""Inputs of jobs that failed by an error of this program, kept beside the history so that the error can be repeated.

python -m quadid_node.failures FILE     # does the job again in this process and prints what becomes of it
"""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path

from quadid.files import read_regular
from quadid.online.records import Job, JobReply
from quadid_node.wire_format import LARGEST, ParcelError, pack, unpack

MOST = 8
"""Newest inputs kept: a minute of flight takes less than a mebibyte."""
SUFFIX = ".job"


def folder_of(history: Path) -> Path:
    """The folder beside a history."""
    return history.with_name(f"{history.name}.failures")


def keep(history: Path, job: Job) -> str:
    """Keeps the input of a job, and the newest `MOST` of all; returns where, or why not, for people."""
    path = folder_of(history) / f"{time.time_ns():020d}-{type(job).__name__}{SUFFIX}"
    try:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(pack(job))
        for old in sorted(path.parent.glob(f"*{SUFFIX}"))[:-MOST]:
            with contextlib.suppress(FileNotFoundError):
                old.unlink()
    except (OSError, ParcelError) as error:
        return f"its input could not be kept ({error})"
    return f"its input is in {path}"


def repeat(path: Path) -> JobReply:
    """Does the job of a kept input again; raises ParcelError for a file that holds none, OSError."""
    reply: JobReply = unpack(read_regular(path, LARGEST)).run()
    return reply


if __name__ == "__main__":
    sys.stdout.write(f"{repeat(Path(sys.argv[1]))}\n")
