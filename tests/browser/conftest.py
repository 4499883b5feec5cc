"""A headless Chromium, and the reports that it opens: one of made-up scores with hostile names, one of real work."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.conftest import REPOSITORY, absent
from tests.report.test_page import page, scored

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SHOTS = REPOSITORY / "browser-out"
"""Screenshots are kept here to be looked at."""


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """The system's Chromium (Debian package), driven by Playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright (extra dev)")
    binary = shutil.which("chromium") or shutil.which("chromium-browser")
    if binary is None:
        absent("no chromium: install Debian's package of that name (apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=binary, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def shots() -> Path:
    """Folder of the screenshots."""
    SHOTS.mkdir(exist_ok=True)
    return SHOTS


@pytest.fixture(scope="session")
def hostile_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of logs whose names, topics and warnings try to run something."""
    from tests.report.test_page import EVIL

    file = tmp_path_factory.mktemp("hostile") / "report.html"
    file.write_text(page([scored(EVIL), scored("b.csv", seed=1)]), encoding="utf-8")
    return file


@pytest.fixture(scope="session")
def demo_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report that `quadid demo --quick` writes."""
    from quadid.cli.demo import demo

    folder = tmp_path_factory.mktemp("demo")
    demo(quick=True, out=folder)
    return folder / "report.html"


@pytest.fixture(scope="session")
def failure_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a flight that could not be used."""
    from dataclasses import replace

    from quadid_replay import write_csv

    from quadid.app.failure import failure_html
    from quadid.errors import LogError
    from quadid.flight import fly
    from quadid.vehicle import Vehicle

    pelican = Vehicle.shipped("pelican")
    folder = tmp_path_factory.mktemp("failure")
    recording = fly(pelican, seconds=20.0, seed=1).recording
    gyro = recording.channels["gyro"]
    wrong = replace(recording, channels={**recording.channels, "gyro": replace(gyro, values=57.3 * gyro.values)})
    write_csv(folder / "degrees.csv", wrong)
    error = LogError("degrees.csv: the gyro does not agree with the attitude", fix="give rad/s")
    file = folder / "report.html"
    file.write_text(failure_html(error, "Identification", [str(folder / "degrees.csv")], pelican, "auto"))
    return file


@pytest.fixture(scope="session")
def fleet_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a fleet of two vehicles, one of which wears; of two others one has a propeller cut."""
    import numpy as np

    from quadid.app.fleet_page import health_trend
    from tests.cli.test_health import PELICAN_X, fleet
    from tests.report.test_fleet_page import rows, summed

    rng = np.random.default_rng(1)
    worn = 1.0 - 0.002 * np.arange(60)
    logs, parameters = rows({n: s + 0.01 * rng.standard_normal(60) for n, s in (("one", np.ones(60)), ("two", worn))})
    gentle, trims = fleet()
    health = health_trend(gentle, trims, dict.fromkeys("ab", PELICAN_X.to_yaml()))
    logs += gentle
    file = tmp_path_factory.mktemp("fleet") / "fleet.html"
    file.write_text(summed(logs, parameters, health).page())
    return file


@pytest.fixture(scope="session")
def health_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a vehicle with a damaged rotor against healthy flights; a log's name tries to run something."""
    from quadid_evaluation.studies.health.flights import Wrong, hover
    from quadid_replay import write_csv

    import quadid
    from quadid.vehicle import Vehicle

    pelican, folder = Vehicle.shipped("pelican_x"), tmp_path_factory.mktemp("health")
    flown = {"now<img src=x onerror=alert(1)>.csv": hover(pelican, Wrong({3: 0.2}, {3: 0.2}), 99)}
    flown |= {f"healthy{k}.csv": hover(pelican, None, k) for k in range(5)}
    for name, recording in flown.items():
        write_csv(folder / name, recording)
    paths = [folder / name for name in flown]
    return quadid.health(paths[0], paths[1:], vehicle=pelican).report(folder / "health.html")
