"""Runs a command as a user does."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Answer = tuple[int, str, Mapping[str, Any]]
"""Exit code, what was said (stdout and stderr), and the JSON."""
QUADID = Path(sys.executable).with_name("quadid")


def answer_of(arguments: Sequence[str | Path]) -> Answer:
    """Exit code, words and JSON of a command."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "answer.json")
        wants = [] if arguments[0] == "init" else ["--json", result]
        run = subprocess.run([QUADID, *arguments, *wants], capture_output=True, text=True, check=False)
        data = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
    return run.returncode, f"{run.stderr}{run.stdout}", data
