"""A log of many hours: its parameters come from as much of it as they need, and that is said."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.flight import draw_truth
from quadid.identification import fit as long_logs
from quadid.identification.fit import FitOptions, fit
from tests.identify.flights import PELICAN, flown, guessed, values_of


def test_the_last_polish_takes_a_bounded_part_of_the_log_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_logs, "MOST_SECONDS", 20.0)
    monkeypatch.setattr(long_logs, "STRETCH", 5.0)
    truth = draw_truth(PELICAN, 3)
    window, vehicle = flown(3).window, guessed(truth)
    found = fit([window], vehicle, FitOptions(iterations=0))
    assert found.warnings[0].startswith("0.0 h of flight are more than the parameters need")
    assert "from 4 of 12 stretches of 5 s" in found.warnings[0]
    error = np.log(found.theta[:6] / values_of(truth))
    assert np.all(np.abs(error) < 4.0 * found.uncertainty.sigma)
    monkeypatch.undo()
    whole = fit([window], vehicle, FitOptions(iterations=0))
    assert not whole.warnings
    assert np.all(whole.uncertainty.sigma < found.uncertainty.sigma), "fewer data, wider intervals"


def test_stretches_of_a_log_are_views_of_it_and_what_may_still_change_is_copied() -> None:
    window = flown(3).window
    assert window.gyro is not None
    part = window.slice(100, 200)
    assert part.gyro is not None
    assert np.shares_memory(part.gyro, window.gyro)
    assert np.shares_memory(part.rotor_speed, window.rotor_speed)
    mine = np.array(window.rotor_speed)
    sealed = mine[:]
    sealed.setflags(write=False)
    for rows in (mine, sealed):
        kept = replace(window, rotor_speed=rows)
        mine[0, 0] += 1.0
        assert kept.rotor_speed[0, 0] == rows[0, 0] - 1.0, "whoever owns these rows may still write to them"
