"""Written results: folders that are checked before long work, and JSON that any parser accepts."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quadid_workflow.files import OutputError as OutputError
from quadid_workflow.files import file_name as file_name
from quadid_workflow.files import write_text as write_text
from quadid_workflow.outcome import json_text as json_text


def out_folder(folder: Path) -> Path:
    """Makes the folder where it does not exist, and returns its absolute path.

    Raises:
        OutputError: it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made ({error.strerror})", "a folder", "choose another --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} is not writable", "a folder you may write to", "choose another --out")
    return folder.resolve()


def check_file(path: Path | str | None, option: str) -> None:
    """Raises OutputError when a file to be written later cannot be; ``-`` and None are fine."""
    if path is None or str(path) == "-":
        return
    file = Path(path)
    if file.is_dir():
        raise OutputError(f"{option} {file} is a directory", "a file name", f"name a file in it: {file / 'result'}")
    folder = file.absolute().parent
    if not folder.is_dir():
        raise OutputError(f"{option}: no folder {folder}", "an existing folder", f"mkdir -p {folder}")
    if not os.access(file if file.exists() else folder, os.W_OK):
        raise OutputError(f"{option}: {file} is not writable", "a file you may write", "choose another place")


def command_line() -> str:
    """The command as it was typed, for reports."""
    return shlex.join(["quadid", *sys.argv[1:]])


def write_json(result: Mapping[str, Any], target: str | None) -> None:
    """Writes a result as JSON to a file, or to stdout for ``-``; numbers that JSON has no word for become null."""
    if target is None:
        return
    text = json_text(result)
    if target == "-":
        sys.stdout.write(text)
    else:
        write_text(Path(target), text)
