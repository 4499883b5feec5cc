"""Shared by all tests: the folder of the recorded flights, and the rule that nothing is skipped in CI."""

import os
from pathlib import Path

# Before NumPy is loaded: workers share the processors, and threads over matrices of ten rows only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest

from tests.commands import inside as inside  # fixtures for every folder
from tests.commands import quadid as quadid
from tests.faults.evidence import Collector
from tests.faults.evidence import happened as happened

REPOSITORY = Path(__file__).resolve().parent.parent
LONG = ("node", "cli", "diagnose", "online", "documents", "examples", "identify", "health", "studies")
"""Folders whose files take long, in the order in which they begin."""

# The first call of a numba kernel compiles it: an example's time says nothing. In CI every run draws the same examples.
hypothesis.settings.register_profile("quadid", deadline=None, print_blob=True, derandomize=bool(os.environ.get("CI")))
hypothesis.settings.load_profile("quadid")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--faults-page FILE`: run the tests that give evidence on faults and write their table (`make faults`)."""
    parser.addoption("--faults-page", metavar="FILE", type=Path, help="write what the tests of faults measured")


def pytest_configure(config: pytest.Config) -> None:
    """Collects evidence where asked; worker processes only pass on what their tests said."""
    page = config.getoption("--faults-page")
    if page is not None:
        collector = Collector(page, "make faults", writes=not hasattr(config, "workerinput"))
        config.pluginmanager.register(collector, "faults")


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One process runs a file from beginning to end: what its tests share is flown, fitted or compiled once.

    Files that take long come first, so that no process ends late; among them those whose nodes mostly wait.
    """
    items.sort(key=_turn)
    for item in items:
        item.add_marker(pytest.mark.xdist_group(str(item.path.relative_to(REPOSITORY))))


def _turn(item: pytest.Item) -> int:
    folder = item.path.relative_to(REPOSITORY).parts[1]
    return LONG.index(folder) if folder in LONG else len(LONG)


def in_ci() -> bool:
    """True where nothing may be skipped for being absent (environment variable CI)."""
    return os.environ.get("CI", "").lower() in ("1", "true", "yes")


def absent(reason: str) -> None:
    """Fail in CI, skip elsewhere: something that the test needs is not on this machine."""
    if in_ci():
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the recorded flights: QUADID_DATA, else ../shared/data beside the repository."""
    folder = Path(os.environ.get("QUADID_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        absent(f"no recorded flights at {folder}: set QUADID_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout under test."""
    return REPOSITORY
