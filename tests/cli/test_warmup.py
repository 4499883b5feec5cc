"""Kernels are compiled before the first fit, in processes side by side; what they compile is what a fit calls."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.cli.conftest import Flights
from tests.commands import Cli

ASK = "from quadid.app.kernels import FIT, missing; print(*missing(FIT))"
SIGNATURES = """
import json, sys, quadid
from quadid.app.kernels import FIT, PARTS
for name in FIT:
    PARTS[name].run()
quadid.identify(quadid.load(sys.argv[1], vehicle="pelican"))
print(json.dumps({k.__name__: len(k.signatures) for name in FIT for k in PARTS[name].kernels()}))
"""


def python(text: str, *arguments: str, **environment: str) -> str:
    """What a Python of its own prints."""
    run = subprocess.run(
        [sys.executable, "-c", text, *arguments], env={**os.environ, **environment}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return run.stdout


def test_what_is_missing_is_known_without_compiling(tmp_path: Path) -> None:
    assert python(ASK, NUMBA_CACHE_DIR=str(tmp_path)).split() == ["simulation", "statistics", "estimate"]


def test_a_fit_calls_what_was_compiled_and_nothing_else(flights: Flights, inside: Cli) -> None:
    counts = json.loads(python(SIGNATURES, str(flights.train)).splitlines()[-1])
    names = ("needs_of", "roll_segments", "rotor_table", "reduce", "fly_closed_loop")
    filters = ("moments", "kalman", "replay", "backward", "single_steps", "specific_force")
    assert counts == dict.fromkeys((*names, *filters), 1)
    assert inside("warmup").out.startswith("Kernels: compiled")
    assert inside("warmup").out == "Kernels: compiled already.\n"
