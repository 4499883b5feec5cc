"""Health: what changed in a vehicle since its healthy flights, from trims, also of gentle flights.

health = assess(trims of flights, trims of healthy flights, vehicle)
"""

from quadid.callable_room import make_callable
from quadid.health.changes import Change, Health, assess
from quadid.health.spread import Healthy, healthy_spread
from quadid.health.trims import AXES, FlightTrim, flight_trim

__all__ = ["AXES", "Change", "FlightTrim", "Health", "Healthy", "assess", "flight_trim", "healthy_spread"]

make_callable(__name__)
