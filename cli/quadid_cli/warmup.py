"""`quadid warmup`: compiles the kernels now, so that the first fit and the first flight need not."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from threading import Thread
from typing import TYPE_CHECKING

from quadid_cli import terminal
from quadid_cli.options import JsonTarget

if TYPE_CHECKING:
    from quadid.workflow.progress import Advance

STAGE = "compiling, once on this machine"
_CHILD = "from quadid.workflow.kernels import compiled; compiled({!r}, lambda done: print(done, flush=True))"


def warmup(json: JsonTarget = None) -> None:
    """Compile all kernels for this machine's processor, in processes side by side; nothing to do where that is done."""
    from quadid.workflow.kernels import PARTS
    from quadid_cli import output

    begin = time.perf_counter()
    with terminal.progress(compiled=()) as advance:
        made = prepare(tuple(PARTS), advance)
    seconds = time.perf_counter() - begin
    output.write_json({"schema": "quadid.warmup/1", "compiled": made, "seconds": seconds}, json)
    what = f"compiled in {seconds:.0f} s" if made else "compiled already"
    terminal.console(quiet=json == "-").print(f"Kernels: {what}.")


def prepare(parts: Sequence[str], advance: Advance) -> list[str]:
    """Compiles what is missing of these parts of `quadid.workflow.kernels`, a process each; returns which were.

    Compiling holds a lock within a process, so only processes make use of more than one core.  What a process fails
    to compile, the work itself compiles, and says why it cannot.
    """
    from quadid.workflow.kernels import PARTS, missing

    wanted = missing(tuple(parts))
    done = dict.fromkeys(wanted, 0)

    def follow(name: str) -> None:
        with subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD.format(name)],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        ) as child:  # fmt: skip
            assert child.stdout is not None
            for line in child.stdout:
                done[name] = int(line)

    threads = [Thread(target=follow, args=(name,), daemon=True) for name in wanted]
    for thread in threads:
        thread.start()
    total = sum(PARTS[name].functions for name in wanted)
    while any(thread.is_alive() for thread in threads):
        advance(STAGE, min(sum(done.values()) / total, 0.99))
        time.sleep(0.2)
    return wanted
