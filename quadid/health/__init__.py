"""Health: what changed in a vehicle since its healthy flights, from trims, also of gentle flights.

health = assess(trims of flights, trims of healthy flights, vehicle)
"""

from quadid.callable_room import make_callable
from quadid.health.changes import Health as Health
from quadid.health.changes import assess as assess
from quadid.health.spread import Healthy as Healthy
from quadid.health.spread import healthy_spread as healthy_spread
from quadid.health.trim_estimation import FlightTrim as FlightTrim
from quadid.health.trim_estimation import flight_trim as flight_trim

make_callable(__name__)
