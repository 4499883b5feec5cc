"""Start of a command: kernels compiled once, folders of strangers, import paths of the release before."""

import importlib
import inspect
import json
import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from quadid_replay.formats import FORMATS, LogFormat

import quadid
from quadid import old_paths
from tests.cli.conftest import Flights
from tests.commands import Cli
from tests.faults.evidence import Happened

# --- Kernels are compiled before the first fit, in processes side by side; what they compile is what a fit calls


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
    """Output of a Python of its own."""
    run = subprocess.run(
        [sys.executable, "-c", text, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout


def test_what_is_missing_is_known_without_compiling(tmp_path: Path) -> None:
    assert python(ASK, NUMBA_CACHE_DIR=str(tmp_path)).splitlines() == ["simulation estimate"]


def test_a_fit_calls_what_was_compiled_and_nothing_else(flights: Flights, inside: Cli) -> None:
    counts = json.loads(python(SIGNATURES, str(flights.train)).splitlines()[-1])
    names = ("roll_segments", "rotor_table", "fly_closed_loop")
    filters = ("moments", "filter_pass", "replay", "backward")
    assert counts == dict.fromkeys((*names, *filters), 1)
    assert inside("warmup").out.startswith("Kernels: compiled")
    assert inside("warmup").out == "Kernels: compiled already.\n"


KERNEL = """
from typing import NamedTuple
from quadid.on_disk import kept

class {name}(NamedTuple):
    x: float

@kept()
def twice(of):
    return 2.0 * of.x

if __name__ != "__main__":
    print(twice({name}(1.5)), sum(twice.stats.cache_hits.values()))
"""


def test_machine_code_on_disk_that_cannot_be_read_is_compiled_again(tmp_path: Path) -> None:
    """A named tuple renamed by an upgrade, and files that a full disk cut short."""
    module, cache = tmp_path / "kernel_on_disk.py", tmp_path / "cache"
    text = "import sys; sys.path.insert(0, sys.argv[1]); import kernel_on_disk"

    def run() -> str:
        return python(text, str(tmp_path), NUMBA_CACHE_DIR=str(cache), PYTHONDONTWRITEBYTECODE="1").strip()

    module.write_text(KERNEL.format(name="Before"))
    assert run() == "3.0 0"
    module.write_text(KERNEL.format(name="Renamed"))
    assert [run(), run()] == ["3.0 0", "3.0 1"]
    for kind in ("nbi", "nbc"):
        for file in cache.rglob(f"*.{kind}"):
            file.write_bytes(file.read_bytes()[:40])
        assert [run(), run()] == ["3.0 0", "3.0 1"], kind


# --- The folder a command is run in may have been packed by a stranger: nothing in it is run


QUADID = Path(sys.executable).with_name("quadid")


@pytest.mark.parametrize(
    "command",
    [
        (str(QUADID), "vehicles"),
        (sys.executable, "-P", "-m", "quadid_node.identify", "flight.mcap"),
        (sys.executable, "-P", "-m", "quadid_node.replay_node", "flight.mcap"),
    ],
)
def test_settings_of_numba_that_lie_in_the_folder_are_refused(
    tmp_path: Path, command: tuple[str, ...], happened: Happened
) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: /tmp/somebody\n")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 2
    assert ".numba_config.yaml in this folder" in done.stderr
    assert done.stderr.count("\n") == 1
    program = Path(command[-2]).name
    happened(34, f"a .numba_config.yaml in the folder we stand in, {program}: '{done.stderr.strip()[:80]}'")


def test_modules_that_lie_in_the_folder_are_not_imported(tmp_path: Path, happened: Happened) -> None:
    for name in ("numpy", "yaml", "typer", "json"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w').close()\nraise SystemExit\n")
    done = subprocess.run([QUADID, "vehicles"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()
    happened(34, "numpy.py, yaml.py, typer.py and json.py in the folder we stand in: not run")


PLANTED = ("html", "multiprocessing", "runpy", "numpy", "distributed", "json", "pickle", "socket", "sitecustomize")
"""Modules that children of libraries import: one in the working folder would run in the place of Python's own."""


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A folder that a stranger packed; `ran` appears in it when one of its modules is imported."""
    folder = tmp_path / "planted"
    folder.mkdir()
    for name in PLANTED:
        (folder / f"{name}.py").write_text(f"open({str(folder / 'ran')!r}, 'a').write(__name__)\nraise ImportError\n")
    return folder


def test_fleet_in_a_folder_with_modules_runs_none_of_them(planted: Path, happened: Happened) -> None:
    (planted / "flight.csv").write_text("t,p,q,r,w1,w2,w3,w4\n0,0,0,0,1,1,1,1\n")
    command: list[str | Path] = [QUADID, "fleet", ".", "--vehicle", "pelican", "--workers", "1", "--out", "out"]
    done = subprocess.run(command, cwd=planted, capture_output=True, text=True, check=False)
    assert not (planted / "ran").exists()
    assert (planted / "out").is_dir(), done.stderr
    happened(34, f"`quadid fleet .` in a folder with {', '.join(PLANTED)}: its workers run none of them")


START = """
import multiprocessing
import quadid
from multiprocessing import shared_memory

if __name__ == "__main__":
    for method in ("spawn", "forkserver"):
        with multiprocessing.get_context(method).Pool(1) as pool:
            assert pool.map(abs, [-1]) == [1]
    shared_memory.SharedMemory(create=True, size=8).unlink()  # starts the resource tracker
"""


@pytest.mark.parametrize("path", [None, ":/nowhere", "/nowhere:"])
def test_processes_of_libraries_do_not_import_from_it_either(planted: Path, path: str | None) -> None:
    script = planted.parent / "elsewhere" / "script.py"
    script.parent.mkdir()
    script.write_text(START)
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONSAFEPATH", "PYTHONPATH")}
    # Python itself looks into the folder for an empty entry of PYTHONPATH: so it is set once it runs.
    if path is not None:
        script.write_text(f"import os\nos.environ['PYTHONPATH'] = {path!r}\n{START}")
    done = subprocess.run(
        [sys.executable, script], cwd=planted, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert not (planted / "ran").exists()


@pytest.mark.parametrize(
    ("start", "lines"),
    [
        ("{here}", "import quadid"),
        ("{here}", "import quadid.vehicle"),
        ("{here}", "import os, quadid.app.logs"),
        ("/", "import os, quadid\nos.chdir('{here}')\nimport quadid.model.kernel"),
    ],
)
def test_a_library_refuses_them_too_also_in_a_folder_that_it_changes_to(tmp_path: Path, start: str, lines: str) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: /tmp/somebody\n")
    where, code = (text.format(here=tmp_path) for text in (start, lines))
    done = subprocess.run([sys.executable, "-c", code], cwd=where, capture_output=True, text=True, check=False)
    assert "ImportError: .numba_config.yaml in this folder" in done.stderr


NUMBA = """
import os, sys, numba, quadid.model.kernel
from numba.core import config
os.chdir(sys.argv[1])
numba.njit(lambda x: x)(1.0)
print(repr(config.CACHE_DIR))
"""


def test_numba_reads_no_settings_in_a_folder_that_a_library_changes_to(tmp_path: Path, happened: Happened) -> None:
    """It looks for them before every compilation, and loads kernels from the folder that they name."""
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: /tmp/somebody\n")
    assert python(NUMBA, str(tmp_path)).split() == ["''"]
    happened(34, "a program compiles in a folder with .numba_config.yaml that it changed to: its settings are not read")


def test_machine_code_is_not_kept_in_the_folder_we_stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As numba does for users without a home."""
    (tmp_path / "kernel_on_disk.py").write_text(KERNEL.format(name="Of"))
    monkeypatch.chdir(tmp_path)
    text = "import sys; sys.path.insert(0, sys.argv[1]); import kernel_on_disk"
    assert python(text, str(tmp_path), NUMBA_CACHE_DIR="here").strip() == "3.0 0"
    assert not [*tmp_path.rglob("*.nbi")]


NOTEBOOK = """
import os, sys
import quadid.app.fleet as fleet
if __name__ == "__main__":
    os.chdir(sys.argv[1])
    sys.path[:0] = ["", os.getcwd()]  # as Python does it in notebooks, and for -m
    with fleet.cluster(None, 1, "2GiB") as client:
        found = client.run(lambda: sys.path)
    print(*(path for paths in found.values() for path in paths), sep="\\n")
    assert sys.path[:2] == ["", os.getcwd()]
"""


def test_workers_of_a_notebook_in_the_folder_do_not_import_from_it(tmp_path: Path, happened: Happened) -> None:
    """Nor from a folder of Dask that anyone may have made before."""
    script = tmp_path / "elsewhere" / "notebook.py"
    script.parent.mkdir()
    (planted := tmp_path / "planted").mkdir()
    script.write_text(NOTEBOOK)
    done = subprocess.run([sys.executable, script, planted], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    searched = done.stdout.splitlines()
    assert str(planted) not in searched
    assert "" not in searched
    assert not [path for path in searched if Path(path).parent == Path(tempfile.gettempdir(), "dask-scratch-space")]
    happened(34, "`quadid.fleet` from a notebook in the folder: its workers do not look into it, nor into /tmp")


# --- Import paths of release 0.1.0: each works and warns; public names stay functions


@pytest.mark.parametrize("old", sorted(old for old in old_paths.new_paths() if not old.startswith("quadid_node")))
def test_an_old_path_is_the_new_module_and_warns(old: str) -> None:
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is "):
        found = importlib.import_module(old)
    assert found is importlib.import_module(old_paths.new_path(old))


def test_no_old_path_takes_the_place_of_a_function() -> None:
    """An import binds a module's last name in the package above it, which is today's."""
    code = (
        "import importlib, types; from quadid import old_paths; "
        "parted = [old.rpartition('.')[::2] for old in old_paths.new_paths()]; "
        "above = [(new, name) for room, name in parted if (new := old_paths.new_path(room))]; "
        "there = [(new, name, getattr(importlib.import_module(new), name, types)) for new, name in above]; "
        "print([(new, name) for new, name, value in there if not isinstance(value, types.ModuleType)])"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("one", FORMATS, ids=lambda one: one.name)
def test_no_reader_of_logs_is_found_by_an_old_path(one: LogFormat) -> None:
    assert not old_paths.new_path("quadid_replay." + one.reader.split(":")[0])


@pytest.mark.parametrize("name", ["identify", "diagnose", "health"])
def test_names_of_rooms_are_functions_also_after_an_old_import(name: str) -> None:
    code = (
        f"import warnings, quadid; warnings.simplefilter('ignore'); import quadid.{name}; "
        f"from quadid.workflow.{name} import {name} as function; assert quadid.{name} is function"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    function = getattr(quadid, name)
    assert inspect.isfunction(function)
    assert pickle.loads(pickle.dumps(function)) is function


@pytest.mark.parametrize(
    "statement",
    [
        "import quadid_cli.main",
        "import quadid.baselines.order",
        "from quadid.identify.fit import fit",
        "from quadid.diagnose import Diagnosis",
    ],
)
def test_old_statements_work_alone(statement: str) -> None:
    done = subprocess.run([sys.executable, "-W", "always", "-c", statement], check=True, capture_output=True, text=True)
    assert "DeprecationWarning" in done.stderr


def test_a_sample_of_release_0_1_0_is_a_message() -> None:
    code = (
        "import quadid.online, quadid.vehicle, quadid.window; s = quadid.window.Sample(1.5, 'gyro', (0.1, 0.2, 3)); "
        "assert (s.channel, s.values, s.t[0]) == ('gyro', (0.1, 0.2, 3.0), 1.5); "
        "quadid.online.Session(quadid.vehicle.Vehicle.shipped('pelican')).push(s)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_what_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("quadid.identify.never_there")
