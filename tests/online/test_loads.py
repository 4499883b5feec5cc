"""Loads and pulls: in hover thrust is the weight, so what is taken up or dropped is named; a landing is not."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Recording
from quadid.online import Session, SessionSettings
from quadid.online.changes import ChangePoint
from quadid.online.records import OnlineFinding
from quadid.online.session import mass_factor
from quadid.vehicle import GRAVITY
from tests.online.driving import diagnosed, drive, events, flight, samples
from tests.online.made_up import PELICAN
from tests.online.test_gate import TRUE

WEIGHT = PELICAN.mass * GRAVITY
AT = 24.3
SETTINGS = SessionSettings(refit=5.0, diagnose=0.0)


def found_in(recording: Recording, within: float = 5.0) -> OnlineFinding:
    """The one finding of a flight in which something changes at `AT`, as it is known so many seconds later."""
    stream = [s for s in samples(recording) if s.t <= AT + within]
    (diagnosis,) = diagnosed(drive(Session(PELICAN, SETTINGS), stream))
    (finding,) = diagnosis.findings
    return finding


@pytest.mark.parametrize("profile", ["hover", "excited"])
@pytest.mark.parametrize("fraction", [0.18, -0.13])
def test_a_load_is_named_within_five_seconds_hovering_and_moving(profile: str, fraction: float) -> None:
    changes = (("mass_change", "time", AT), ("mass_change", "fraction", fraction))
    finding = found_in(flight(AT + 6.0, 4, profile, changes).recording)
    assert finding.effect == "mass_change"
    assert finding.values["fraction"] == pytest.approx(fraction, rel=0.15)
    assert {a.effect for a in finding.alternatives} >= {"steady_pull", "thrust_drop"}
    newtons = re.search(r"([+-][0-9.]+) N to hold", finding.evidence)
    assert newtons is not None, finding.evidence
    assert float(newtons[1]) == pytest.approx(fraction * WEIGHT, rel=0.15)


@pytest.mark.parametrize(("share", "profile"), [(0.15, "excited"), (-0.12, "excited"), (0.15, "hover")])
def test_a_pull_is_told_from_a_load_where_the_vehicle_moves(share: float, profile: str) -> None:
    made = flight(AT + 6.0, 4, profile).recording
    speed = made.channels["rotor_speed"]
    more = np.where(speed.t > AT, share * WEIGHT / 4.0 / TRUE["b"], 0.0)[:, None]
    pulled = replace(speed, values=np.sqrt(np.maximum(speed.values**2 + more, 1.0)))
    finding = found_in(replace(made, channels={**made.channels, "rotor_speed": pulled}))
    told = {finding.effect, *(a.effect for a in finding.alternatives)}
    assert told >= {"steady_pull", "mass_change"}
    if profile == "excited":
        assert (finding.effect, finding.confident) == ("steady_pull", True)
        assert finding.values["force"] == pytest.approx(share * WEIGHT, rel=0.1)
    else:
        assert not finding.confident


@pytest.mark.parametrize("seconds", [1.5, 3.0])
def test_a_landing_is_no_change(seconds: float) -> None:
    """The floor takes the weight over while the rotors slow down, and the accelerometer goes on reading gravity."""
    made = flight(AT + 10.0, 4, "hover").recording
    speed, force = made.channels["rotor_speed"], made.channels["accel"]
    down = np.clip((speed.t - AT) / seconds, 0.0, 1.0)[:, None]
    rng = np.random.default_rng(1)
    stands = np.array([0.0, 0.0, -GRAVITY]) + 0.1 * rng.normal(size=force.values.shape)
    landed = {
        "rotor_speed": replace(speed, values=speed.values * (1.0 - 0.8 * down)),
        "accel": replace(force, values=np.where(force.t[:, None] > AT, stands, force.values)),
    }
    actions = drive(Session(PELICAN, SETTINGS), samples(replace(made, channels={**made.channels, **landed})))
    assert not events(actions, "change")
    assert not diagnosed(actions)


def test_what_may_be_a_mass_holds_sets_back_and_what_is_not_does_not() -> None:
    step = ChangePoint(10.0, "thrust", -0.18, 20.0)

    def finding(effect: str, confident: bool, **values: float) -> OnlineFinding:
        return OnlineFinding(effect, values, {}, {}, 2.0, 1.0, 1e-9, (), "", confident)

    assert mass_factor(step, finding("mass_change", True, fraction=0.2)) == pytest.approx(1.2)
    assert mass_factor(step, finding("thrust_drop", False, fraction=0.16)) == pytest.approx(math.exp(0.18))
    assert mass_factor(step, finding("steady_pull", True, force=2.0)) == pytest.approx(math.exp(0.18))
    assert mass_factor(step, None) == pytest.approx(math.exp(0.18))
    assert mass_factor(step, finding("thrust_drop", True, fraction=0.16)) == 1.0
    assert mass_factor(replace(step, channel="roll moment"), None) == 1.0
