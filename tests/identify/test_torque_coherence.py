"""Inertias left open where torque and motion do not cohere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import quadid
from quadid.data.window import Window
from quadid.identification.fast_motion import LEAST_COHERENCE, undecided
from quadid.parameters import Status
from quadid.types import FloatArray
from tests.identify.flights import PELICAN

DT = 0.01
INERTIA_OVER_B = 1.0e3


def window(unknown: float, lost: float = 0.0, seconds: float = 60.0) -> Window:
    """Turning about x and y by rotor torques and, in the share `unknown` of the power, by what no rotor makes."""
    rng = np.random.default_rng(4)
    rows = round(seconds / DT)
    squares = 3.0e5 + 2.0e4 * rng.standard_normal((rows, 4))
    x, y = PELICAN.rotor_positions[:, 0], PELICAN.rotor_positions[:, 1]
    torque = squares @ np.column_stack([-y, x])
    other = rng.standard_normal((rows, 2)) * torque.std(axis=0) * np.sqrt(unknown / (1.0 - unknown))
    gyro: FloatArray = np.zeros((rows, 3))
    gyro[:, :2] = np.cumsum(torque - torque.mean(axis=0) + other, axis=0) * DT / INERTIA_OVER_B
    gyro[rng.random(rows) < lost] = np.nan
    return Window(0.0, DT, np.sqrt(squares), gyro=gyro, sampling="instant")


def share_open(one: Window, white: float = 0.0) -> FloatArray:
    """Share by which J_xx and J_yy are undecided."""
    return undecided([one], PELICAN, np.full(2, white))


@pytest.mark.parametrize("lost", [0.0, 0.02])
@pytest.mark.parametrize("unknown", [0.02, 0.2, 0.5])
def test_what_rotors_do_not_make_is_undecided(unknown: float, lost: float) -> None:
    found = share_open(window(unknown, lost))
    assert found == pytest.approx(-np.log(1.0 - unknown), rel=0.15, abs=0.02)


def test_noise_of_the_gyro_leaves_nothing_open() -> None:
    one, white = window(0.02), 0.05
    assert one.gyro is not None
    noisy = replace(one, gyro=one.gyro + white * np.random.default_rng(5).standard_normal(one.gyro.shape))
    assert np.all(share_open(noisy) > 0.1)
    assert np.all(share_open(noisy, white) < 0.06)


def test_a_lag_takes_nothing_away() -> None:
    one = window(0.02)
    late = replace(one, rotor_speed=np.roll(one.rotor_speed, -3, axis=0))
    assert np.all(share_open(late) < 0.06)


@pytest.mark.parametrize("seconds", [0.5, 0.9])
def test_stretches_too_short_for_a_spectrum_decide_nothing(seconds: float) -> None:
    assert share_open(window(0.02, seconds=seconds)) == pytest.approx(-np.log(LEAST_COHERENCE))


@pytest.mark.parametrize(("name", "sure"), [("random_run3", False), ("chirp_run1", False), ("square_run3", True)])
def test_an_inertia_that_rotor_speeds_cannot_decide_is_not_called_known(data_dir: Path, name: str, sure: bool) -> None:
    """Nano-drone, flights of smoothed states beside raw rotor speeds: J was identified where it is 30 to 90 % high."""
    folder = data_dir / "nanodrone"
    found = quadid.identify(quadid.load(folder / f"{name}.csv", folder / "vehicle.yaml"))
    statuses = {found.parameters[n].status for n in ("J_xx", "J_yy")}
    assert (statuses & {Status.IDENTIFIED, Status.RATIO_ONLY} != set()) == sure
    told = [w.split(":")[0] for w in found.warnings if "of quick angular acceleration only" in w]
    assert told == ([] if sure else ["J_xx", "J_yy"]), "each inertia has a share of its own"
