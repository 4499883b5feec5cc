"""The stabiliser of the flown vehicle: gains tuned on the type's truth; its law is `quadid.attitude_controller`."""

from __future__ import annotations

import numpy as np

from quadid.flight.truth import TruthParameters
from quadid.vehicle import Vehicle

ANGLE_BANDWIDTH, YAW_BANDWIDTH = 4.5, 1.5
RATE_BANDWIDTH, YAW_RATE_BANDWIDTH = 11.0, 3.0
RATE_INTEGRAL, YAW_INTEGRAL = 14.0, 1.5
MAX_OVER_HOVER, MIN_OVER_HOVER = 1.8, 0.25


def default_gains(vehicle: Vehicle) -> dict[str, float]:
    """Gains tuned on the type's truth (`TruthParameters.of`), stable with commands held over 20 ms.

    Bandwidths: angle 4.5 1/s (yaw 1.5), rate 11 1/s (yaw 3).  They leave room for 60 ms of rotor lag or 40 ms of delay.
    """
    base = TruthParameters.of(vehicle)
    hover = base.hover_speed(len(vehicle.rotors))
    yaw_torque = 0.3 * base.d * len(vehicle.rotors) * hover**2
    fastest = min(MAX_OVER_HOVER * hover, vehicle.command.max_speed or np.inf)
    return {
        "roll_p": ANGLE_BANDWIDTH,
        "pitch_p": ANGLE_BANDWIDTH,
        "yaw_p": YAW_BANDWIDTH,
        "roll_rate_p": RATE_BANDWIDTH * base.J_xx,
        "pitch_rate_p": RATE_BANDWIDTH * base.J_yy,
        "yaw_rate_p": YAW_RATE_BANDWIDTH * base.J_zz,
        "roll_rate_i": RATE_INTEGRAL * base.J_xx,
        "pitch_rate_i": RATE_INTEGRAL * base.J_yy,
        "yaw_rate_i": YAW_INTEGRAL * base.J_zz,
        "yaw_rate_limit": 1.5,
        "roll_pitch_rate_limit": 4.0,
        "yaw_torque_limit": yaw_torque,
        "thrust_coefficient": base.b,
        "drag_coefficient": base.d,
        "min_speed": MIN_OVER_HOVER * hover,
        "max_speed": float(fastest),
    }
