"""Health: what changed in a vehicle since its healthy flights, from trims, also of gentle flights.

health = assess(trims of flights, trims of healthy flights, vehicle)
"""

from quadid.condition.changes import Health as Health
from quadid.condition.changes import assess as assess
from quadid.condition.trim import FlightTrim as FlightTrim
from quadid.condition.trim import Healthy as Healthy
from quadid.condition.trim import flight_trim as flight_trim
from quadid.condition.trim import healthy_spread as healthy_spread
