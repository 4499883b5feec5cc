"""The vehicle: a closed-loop truth at 1 kHz with its own equations, which never meet those of the model under test.

flight = fly(Vehicle.shipped("pelican"), seconds=120, seed=1, effects={"motor_lag": {"tau": 0.03}})
flight.window, flight.recording      what a log holds
flight.truth                         what really happened, for tests only
"""

from quadid.flight.fly import Flight as Flight
from quadid.flight.fly import FlightError as FlightError
from quadid.flight.fly import SteppedFlight as SteppedFlight
from quadid.flight.fly import fly as fly
from quadid.flight.loop import SensorNoise as SensorNoise
from quadid.flight.outside import OUTSIDE as OUTSIDE
from quadid.flight.outside import draw_outside as draw_outside
from quadid.flight.pilot import PROFILES as PROFILES
from quadid.flight.pilot import Segment as Segment
from quadid.flight.pilot import default_gains as default_gains
from quadid.flight.setup import TruthParameters as TruthParameters
from quadid.flight.setup import check_effects as check_effects
from quadid.flight.setup import draw_effect as draw_effect
from quadid.flight.setup import draw_truth as draw_truth
from quadid.flight.setup import propeller_radius as propeller_radius
