"""The vehicle: a closed-loop truth at 1 kHz with its own equations, which never meet those of the model under test.

flight = fly(Vehicle.shipped("pelican"), seconds=120, seed=1, effects={"motor_lag": {"tau": 0.03}})
flight.window, flight.recording      what a log holds
flight.truth                         what really happened, for tests only
"""

from quadid.flight.draw import draw_effect
from quadid.flight.fly import FlightError, fly
from quadid.flight.outside import OUTSIDE, draw_outside
from quadid.flight.profiles import AXES, PROFILES, Segment
from quadid.flight.record import Flight, Truth
from quadid.flight.sensors import SensorNoise
from quadid.flight.setup import check_effects, propeller_radius
from quadid.flight.stabiliser import (
    GAIN_NAMES,
    GAIN_UNITS,
    default_gains,
    mixer_matrix,
    pack_gains,
    stabilise,
    stabiliser_step,
)
from quadid.flight.truth import TruthParameters, draw_truth

__all__ = [
    "AXES",
    "GAIN_NAMES",
    "GAIN_UNITS",
    "OUTSIDE",
    "PROFILES",
    "Flight",
    "FlightError",
    "Segment",
    "SensorNoise",
    "Truth",
    "TruthParameters",
    "check_effects",
    "default_gains",
    "draw_effect",
    "draw_outside",
    "draw_truth",
    "fly",
    "mixer_matrix",
    "pack_gains",
    "propeller_radius",
    "stabilise",
    "stabiliser_step",
]
