"""The pilot: keeps the vehicle in the box, and moves the sticks on top of that.

Works at 50 Hz on what a pilot sees (true position, velocity, heading), so its corrections carry no sensor noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.flight.jit import kernel
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

PILOT_STEP = 0.02
"""Time between two looks of the pilot [s]."""


class Pilot(NamedTuple):
    """How firmly the pilot holds the vehicle in place.

    Attributes:
        altitude: wanted height above the ground, which is at world z = 0 [m].
        hover_throttle: throttle that carries the weight in hover.
        hold: position gain [1/s^2]; brake: velocity gain [1/s], horizontally.
        climb_hold: height gain [1/s^2]; climb_brake: vertical velocity gain [1/s]; trim: integral gain [1/s^3].
        horizon: how quickly the pilot corrects a tilt that stays away from what was asked for [1/s]; a human looks at
            the horizon, and so survives an attitude filter that drifts.
        reach: largest horizontal acceleration asked for [m/s^2].
        tilt_limit: largest roll or pitch reference [rad].
        throttle_limits: lowest and highest throttle.
    """

    altitude: float
    hover_throttle: float
    hold: float = 0.03
    brake: float = 0.22
    climb_hold: float = 0.5
    climb_brake: float = 1.2
    trim: float = 0.1
    horizon: float = 0.8
    reach: float = 2.0
    tilt_limit: float = 0.5
    throttle_limits: tuple[float, float] = (0.08, 0.85)


@kernel
def fly_by_hand(
    pilot: Pilot,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    stick: FloatArray,
    memory: FloatArray,
    reference: FloatArray,
) -> None:
    """One look of the pilot: corrections plus stick movement give the references of the stabiliser.

    Args:
        pilot: gains.
        position: world NED [m].
        velocity: world NED [m/s].
        attitude: rotation matrix, body to world.
        stick: roll, pitch to add [rad], yaw [rad], collective to add [fraction of hover thrust].
        memory: trim of the collective [m/s^2], of roll and of pitch [rad], shape (3,); updated.
        reference: roll, pitch, yaw [rad], throttle 0..1; written.
    """
    ask_north = -pilot.hold * position[0] - pilot.brake * velocity[0]
    ask_east = -pilot.hold * position[1] - pilot.brake * velocity[1]
    size = np.sqrt(ask_north * ask_north + ask_east * ask_east)
    if size > pilot.reach:
        ask_north, ask_east = ask_north * pilot.reach / size, ask_east * pilot.reach / size
    yaw = np.arctan2(attitude[1, 0], attitude[0, 0])
    forward = np.cos(yaw) * ask_north + np.sin(yaw) * ask_east
    right = -np.sin(yaw) * ask_north + np.cos(yaw) * ask_east
    limit = pilot.tilt_limit
    wanted_roll, wanted_pitch = np.arctan(right / GRAVITY) + stick[0], np.arctan(-forward / GRAVITY) + stick[1]
    roll = np.arctan2(attitude[2, 1], attitude[2, 2])
    pitch = -np.arcsin(min(max(attitude[2, 0], -1.0), 1.0))
    memory[1] = min(max(memory[1] + pilot.horizon * (wanted_roll - roll) * PILOT_STEP, -0.3), 0.3)
    memory[2] = min(max(memory[2] + pilot.horizon * (wanted_pitch - pitch) * PILOT_STEP, -0.3), 0.3)
    reference[0] = min(max(wanted_roll + memory[1], -limit), limit)
    reference[1] = min(max(wanted_pitch + memory[2], -limit), limit)
    reference[2] = stick[2]

    low = -pilot.altitude - position[2]
    # positive `low`: above the wanted height (z counts down)
    memory[0] = min(max(memory[0] - pilot.trim * low * PILOT_STEP, -0.5 * GRAVITY), 0.5 * GRAVITY)
    lift = -pilot.climb_hold * low + pilot.climb_brake * velocity[2] + memory[0]
    lift = min(max(lift, -0.5 * GRAVITY), 0.6 * GRAVITY)
    upright = max(attitude[2, 2], 0.6)
    throttle = pilot.hover_throttle * (1.0 + lift / GRAVITY + stick[3]) / upright
    reference[3] = min(max(throttle, pilot.throttle_limits[0]), pilot.throttle_limits[1])
