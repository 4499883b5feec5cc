"""The folder a command is run in may have been packed by a stranger: nothing in it is run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.evidence import Happened

QUADID = Path(sys.executable).with_name("quadid")


def test_settings_of_numba_that_lie_in_the_folder_are_refused(tmp_path: Path, happened: Happened) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: /tmp/somebody\n")
    done = subprocess.run([QUADID, "vehicles"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert ".numba_config.yaml in this folder" in done.stderr
    assert done.stderr.count("\n") == 1
    happened(25, f"a .numba_config.yaml in the folder we stand in: '{done.stderr.strip()[:80]}'")


@pytest.mark.parametrize("module", ["identify", "replay_node"])
def test_so_does_the_ros_node(tmp_path: Path, module: str, happened: Happened) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: /tmp/somebody\n")
    command = [sys.executable, "-P", "-m", f"quadid_node.{module}", "flight.mcap"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert ".numba_config.yaml in this folder" in done.stderr
    assert done.stderr.count("\n") == 1
    happened(25, f"the same before the ROS node's {module}: '{done.stderr.strip()[:80]}'")


def test_modules_that_lie_in_the_folder_are_not_imported(tmp_path: Path, happened: Happened) -> None:
    for name in ("numpy", "yaml", "typer", "json"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w').close()\nraise SystemExit\n")
    done = subprocess.run([QUADID, "vehicles"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()
    happened(25, "numpy.py, yaml.py, typer.py and json.py in the folder we stand in: not run")
