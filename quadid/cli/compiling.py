"""Compiles what a command needs before it works, in processes side by side."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from threading import Thread
from typing import TYPE_CHECKING

from quadid.app.kernels import PARTS, missing

if TYPE_CHECKING:
    from quadid.app.outcome import Advance

STAGE = "compiling, once on this machine"
_CHILD = "from quadid.app.kernels import compiled; compiled({!r}, lambda done: print(done, flush=True))"


def prepare(parts: Sequence[str], advance: Advance) -> list[str]:
    """Compiles what is missing of these parts of `quadid.app.kernels`, a process each; returns which were.

    Compiling holds a lock within a process, so only processes make use of more than one core.  What a process fails
    to compile, the work itself compiles, and says why it cannot.
    """

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
