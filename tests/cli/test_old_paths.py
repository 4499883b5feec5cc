"""Import paths of the release before: each works and warns; public names stay functions."""

from __future__ import annotations

import importlib
import inspect
import pickle
import subprocess
import sys

import pytest
from quadid_replay.formats import FORMATS, LogFormat

import quadid
from quadid import old_paths


@pytest.mark.parametrize("old", sorted(old for old in old_paths.new_paths() if not old.startswith("quadid_node")))
def test_an_old_path_is_the_new_module_and_warns(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is "):
        found = importlib.import_module(old)
    assert found is importlib.import_module(old_paths.new_path(old))


@pytest.mark.parametrize("one", FORMATS, ids=lambda one: one.name)
def test_no_reader_of_logs_is_found_by_an_old_path(one: LogFormat) -> None:
    assert not old_paths.new_path("quadid_replay." + one.reader.split(":")[0])


@pytest.mark.parametrize("name", ["identify", "diagnose", "health"])
def test_names_of_rooms_are_functions_also_after_an_old_import(name: str) -> None:
    code = (
        f"import warnings, quadid; warnings.simplefilter('ignore'); import quadid.{name}; "
        f"from quadid_workflow.{name} import {name} as function; assert quadid.{name} is function"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    function = getattr(quadid, name)
    assert inspect.isfunction(function)
    assert pickle.loads(pickle.dumps(function)) is function


@pytest.mark.parametrize("statement", [
    "from quadid_report.page import render", "import quadid_cli.main", "import quadid_paper.subspace",
    "from quadid.identify.fit import fit", "from quadid.diagnose import Diagnosis",
    "from quadid.health.trim_estimation import FlightTrim",
])  # fmt: skip
def test_old_statements_work_alone(statement: str) -> None:
    done = subprocess.run([sys.executable, "-W", "always", "-c", statement], check=True, capture_output=True, text=True)
    assert "DeprecationWarning" in done.stderr


def test_what_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("quadid.identify.never_there")
