"""Identification: from windows of flight data to parameters with honest intervals."""

from quadid.callable_room import make_callable

make_callable(__name__)
