"""A manoeuvre as parameters and in words: what they ask for is what was simulated, and the envelope stands in each."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadid.errors import ParameterError
from quadid.flight import Segment
from quadid.flight.pilot import AXES, PILOT_STEP, scripted
from quadid.report.manoeuvres import FORMS, written_as
from tests.report.manoeuvre_plan import PLAN


def parameters(text: str) -> dict[str, float]:
    """Name and value of every line that is no comment."""
    lines = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in lines}


@pytest.mark.parametrize("form", list(FORMS))
def test_every_form_says_envelope_and_promise(form: str) -> None:
    for text in written_as(PLAN, form, 0.3).values():
        head = " ".join(text.splitlines()[:5])
        assert "10 to 40 m above take-off" in head
        assert "tilt 33 deg" in head
        assert "40 % of the battery" in head
        assert ("J_r unknown" if form == "ardupilot-sid" else "J_r ± 2 %") in head
        assert "@" not in text


def test_system_id_has_one_file_an_axis_in_its_units() -> None:
    files = written_as(PLAN, "ardupilot-sid", 0.3)
    assert list(files) == [".sid_1_roll.param", ".sid_2_throttle.param"]
    roll, throttle = (parameters(text) for text in files.values())
    assert (roll["SID_AXIS"], throttle["SID_AXIS"]) == (1, 13)
    assert roll["SID_MAGNITUDE"] == pytest.approx(math.degrees(0.2), rel=1e-5)
    assert throttle["SID_MAGNITUDE"] == pytest.approx(0.3 * 0.1)
    assert (roll["SID_F_START_HZ"], roll["SID_F_STOP_HZ"], roll["SID_T_REC"]) == (0.5, 3.5, 14.5)
    assert (roll["FENCE_ALT_MIN"], roll["FENCE_ALT_MAX"], roll["ANGLE_MAX"]) == (10, 40, 3300)
    # The mode refuses sweeps shorter than two swings of the lowest frequency.
    assert roll["SID_T_REC"] > 2.0 / roll["SID_F_START_HZ"]


def test_a_sweep_runs_from_its_lowest_to_its_highest_frequency() -> None:
    segments = [Segment(axis, "sweep", 0.0, 20.0, 0.2, 0.5, 4.0) for axis in ("roll", "yaw")]
    sticks = scripted(segments, 1, 1100)
    roll, yaw = (sticks[:, AXES.index(axis)] for axis in ("roll", "yaw"))
    np.testing.assert_allclose(sticks[1000:], 0.0, atol=1e-12)
    assert np.abs(roll[100:900]).max() == pytest.approx(0.2, rel=0.02)
    crossings = PILOT_STEP * np.flatnonzero(np.diff(np.sign(roll[25:950])))
    swings = 0.5 / np.diff(crossings)
    assert swings[:3] == pytest.approx(0.5, rel=0.1)
    assert swings[-3:] == pytest.approx(3.6, rel=0.15)
    # On yaw the rate sweeps: the same curve, and an angle that shrinks as it quickens.
    np.testing.assert_allclose(np.diff(yaw[:1000]) / PILOT_STEP, roll[1:1000], atol=1e-9)


def test_sticks_are_told_in_degrees_and_alike_blocks_once() -> None:
    (text,) = written_as(PLAN, "sticks", 0.3).values()
    assert "1. 6 s of swinging to and fro, from 0.8 to 2 times a second" in text
    assert f"roll {math.degrees(0.2 * math.sqrt(2.0)):.0f} degrees to each side" in text
    assert "throttle 14 % about hover" in text
    assert "2. 6 s" in text


def test_an_unknown_form_names_the_nearest() -> None:
    with pytest.raises(ParameterError, match="ardupilot-lua"):
        written_as(PLAN, "ardupilot-luo", 0.3)
