"""Pictures of README and documentation, made anew into docs/images: python tools/pictures.py (needs chromium)."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot
from playwright.sync_api import Page, sync_playwright
from quadid_replay import write_csv

import quadid
from quadid.chi_square import Z95
from quadid.flight import Flight, fly
from quadid.model.layout import Layout
from quadid.report.figures import residual_map
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
PELICAN = Vehicle.shipped("pelican")
WITHOUT, WITH = "#c4520a", "#1565c0"
"""Colours of the reports."""
FROM = 20
"""Begin of the pictures of the fit [s]."""
DRAG = {"k_x": 0.3, "k_y": 0.3}
SHOWN: dict[str, dict[str, float]] = {
    "rotor_drag": DRAG,
    "axial_inflow": {"k_z": 0.3},
    "weak_rotor": {"rotor": 2, "loss": 0.06},
    "motor_lag": {"tau": 0.04},
    "imu_lever_arm": {"x": 0.04, "y": 0.0, "z": 0.0},
    "battery_sag": {"fraction": 0.1},
}


def main() -> None:
    """All four pictures."""
    mpl.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
    IMAGES.mkdir(exist_ok=True)
    draw_effects(IMAGES / "effects.png")
    draw_fit(IMAGES / "fit.png")
    screenshots(IMAGES / "report.png", IMAGES / "missing.png")


def draw_effects(file: Path) -> None:
    """Mean residual of six flights without and with the one effect that acts in each."""
    figure, axes = pyplot.subplots(2, 3, figsize=(9.0, 4.6), layout="constrained")
    for box, (effect, values) in zip(axes.flat, SHOWN.items(), strict=True):
        flight = fly(PELICAN, seconds=120.0, seed=3, effects={effect: values}, extras=("velocity",))
        vehicle = PELICAN.model_copy(update={"effects": {effect: values}})
        layout = Layout(vehicle)
        theta = layout.initial(vehicle)
        for name in ("b", "d", "J_xx", "J_yy", "J_zz", "J_r"):
            theta[layout.entry(name).index] = getattr(flight.truth.parameters, name)
        names = [name for name in layout.entries if name.startswith(f"{effect}.")]
        found = residual_map([flight.window], vehicle, theta, effect, names)
        assert found is not None, effect
        style = {"marker": ".", "linewidth": 1.0}
        box.errorbar(found.x, found.before, found.before_error, color=WITHOUT, label="without it", **style)
        box.errorbar(found.x, found.after, found.after_error, color=WITH, label="with it", **style)
        box.set(
            title=effect,
            xlabel=f"{found.against} [{found.against_unit or 1}]",
            ylabel=f"{found.channel} [{found.unit}]",
        )
    axes[0, 0].legend()
    figure.savefig(file, dpi=130)


def draw_fit(file: Path) -> None:
    """A simulation without and with restarts; the missing force that a filter finds, and the drag that acted."""
    flight = fly(PELICAN, seconds=60.0, seed=3, effects={"rotor_drag": DRAG})
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "flight.csv")
        write_csv(log, flight.recording)
        fit = quadid.identify(log, vehicle="pelican")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.0, 2.8), layout="constrained")
    # Left: the guess of the vehicle file with the logged rotor speeds, started once and in every segment.
    truth, rows = flight.truth, np.arange(FROM * 50, (FROM + 3) * 50)
    assert flight.window.attitude is not None
    left.plot(truth.t[rows], pitch(flight.window.attitude[rows]), "k--", linewidth=0.8, label="measured")
    for color, label, length in ((WITHOUT, "simulated from 20 s on", len(rows)), (WITH, "started every 0.2 s", 10)):
        for k in rows[::length]:
            name = label if k == rows[0] else None
            left.plot(truth.t[k : k + length], simulated(flight, k, length), color=color, label=name)
    left.set(xlabel="time [s]", ylabel="pitch [deg]")
    left.legend()
    # Right: missing force forward.
    missing = fit.missing(model="nominal").to_frame()
    t, force, sigma = (missing.index.to_numpy(), missing["force_x"].to_numpy(), missing["force_sigma_x"].to_numpy())
    body = rotated(conjugate(truth.quaternion), truth.velocity)
    right.fill_between(t, force - Z95 * sigma, force + Z95 * sigma, color=WITH, alpha=0.25, linewidth=0.0)
    right.plot(truth.t, -PELICAN.mass * DRAG["k_x"] * body[:, 0], "k--", linewidth=0.8, label="drag that acted")
    right.plot(t, force, color=WITH, label="missing, according to the filter")
    right.set(xlim=(FROM, FROM + 20.0), xlabel="time [s]", ylabel="force forward [N]")
    right.legend()
    figure.savefig(file, dpi=130)


def simulated(flight: Flight, first: int, rows: int) -> FloatArray:
    """Pitch [deg] that the vehicle file's guess simulates from the true state of a row on."""
    truth, simulator, attitudes = flight.truth, quadid.Simulator(PELICAN), list[FloatArray]()
    turning = {"attitude": truth.quaternion[first], "rate": truth.rates[first]}
    state = simulator.start(velocity=truth.velocity[first], dt=0.02, **turning)
    for speeds in flight.window.rotor_speed[first : first + rows]:
        attitudes.append(state.attitude[0])
        state = simulator.step(state, speeds, 0.02)
    return pitch(np.array(attitudes))


def pitch(attitude: FloatArray) -> FloatArray:
    """Pitch [deg] of quaternions, shape (n, 4)."""
    w, x, y, z = attitude.T
    return np.asarray(np.degrees(np.arcsin(2.0 * (w * y - z * x))))


def screenshots(report: Path, missing: Path) -> None:
    """Top of an identification's report; verdict and missing moment of a diagnosis."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        here = Path(folder)
        for seed in (1, 2):
            quadid.simulate("pelican", seconds=60.0, seed=seed).save(here / f"set{seed}.csv")
            lag = ["motor_lag:tau=0.03"]
            quadid.simulate("pelican", seconds=60.0, seed=seed, effects=lag).save(here / f"late{seed}.csv")
        fit = quadid.identify(here / "set1.csv", validate=here / "set2.csv", vehicle="pelican")
        found = quadid.diagnose(here / "late1.csv", validate=here / "late2.csv", vehicle="pelican")
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 960, "height": 900}, device_scale_factor=1.25)
        page.goto(Path(fit.report(here / "fit.html")).as_uri())
        settle(page, ".plot")
        page.screenshot(path=report)
        page.goto(Path(found.report(here / "found.html")).as_uri())
        settle(page, ".plot")
        page.locator(".verdict").first.screenshot(path=here / "verdict.png")
        page.locator("figure", has=page.locator("#plot-missing-moment")).screenshot(path=here / "moment.png")
        parts = [pyplot.imread(here / name) for name in ("verdict.png", "moment.png")]
        browser.close()
    width = max(part.shape[1] for part in parts)
    white = [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=1.0) for p in parts]
    pyplot.imsave(missing, np.concatenate(white))


def settle(page: Page, selector: str) -> None:
    """Scrolls to the first figures until they are drawn, and back."""
    for box in page.query_selector_all(selector)[:4]:
        box.scroll_into_view_if_needed()
        page.wait_for_timeout(1500)
    page.evaluate("scrollTo(0, 0)")


if __name__ == "__main__":
    main()
