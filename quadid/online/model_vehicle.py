"""The vehicle that windows are fitted with where every effect is fitted along: its bare guesses have room."""

from __future__ import annotations

from quadid.vehicle import Vehicle

ROOM = 16.0
"""A bare guess may be wrong by this factor each way; how sure it is stays as it was.

What the nominal model made of a flight that it misses is no better guess: it may be wrong by as much.
"""


def with_room(vehicle: Vehicle) -> Vehicle:
    """The vehicle with wide bounds about its bare guesses, as sure of these as before; bounds that it gives stay."""
    parameters = {}
    for name, given in vehicle.parameters.items():
        bounds = given.bounds or (given.initial / ROOM, given.initial * ROOM)
        sigma = given.sigma or (None if given.bounds else given.log_sigma * given.initial)
        parameters[name] = given.model_copy(update={"bounds": bounds, "sigma": sigma})
    return vehicle.model_copy(update={"parameters": parameters})
