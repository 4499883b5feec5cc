"""`quadid warmup`: compiles the kernels now, so that the first fit and the first flight need not."""

import time

from quadid.app.kernels import PARTS, prepare
from quadid.app.options import JsonTarget
from quadid.cli import terminal


def warmup(json: JsonTarget = None) -> None:
    """Compile all kernels for this machine's processor, in processes side by side; nothing to do where that is done."""
    terminal.check_file(json, "--json")
    begin = time.perf_counter()
    with terminal.progress() as advance:
        made = prepare(tuple(PARTS), advance)
    seconds = time.perf_counter() - begin
    terminal.write_json({"schema": "quadid.warmup/1", "compiled": made, "seconds": seconds}, json)
    what = f"compiled in {seconds:.0f} s" if made else "compiled already"
    terminal.console(quiet=json == "-").print(f"Kernels: {what}.")
