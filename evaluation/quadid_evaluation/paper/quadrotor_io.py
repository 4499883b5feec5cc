"""What a black-box model of a multirotor sees of a window: rotor speeds squared in, nine measurements out.

No physics is put in but that thrust and torque go with the square of the rotor speed, Eqs. (3)-(4) of the paper; the
subspace method finds a linear relation about the mean of the data.
"""

from __future__ import annotations

import numpy as np

from quadid.data.window import Window
from quadid.errors import WindowError
from quadid.rotation import euler
from quadid.types import FloatArray

OUTPUT_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z")
"""Outputs in the order of the physical model's residual channels."""
OUTPUT_UNITS = ("rad/s",) * 3 + ("rad",) * 3 + ("m/s^2",) * 3
FEEDTHROUGH = (False,) * 6 + (True,) * 3
"""Rotor speeds act at once on the specific force, through an integration on rates and angles.  The stabiliser computes
row k of the rotor speeds from rates and angles of the same instant: allowing a direct effect there would mistake the
stabiliser for the vehicle."""


def quadrotor_io(window: Window) -> tuple[FloatArray, FloatArray]:
    """Returns inputs and outputs of a window for `fit_subspace` and `predict`.

    Returns:
        inputs: rotor speeds squared [rad^2/s^2], shape (n, rotors).
        outputs: rates [rad/s], Euler angles, yaw unwrapped [rad], specific force [m/s^2], shape (n, 9), as
            `OUTPUT_NAMES`; NaN where not measured.

    Raises:
        WindowError: rates, attitude or specific force are absent.
    """
    if window.gyro is None or window.attitude is None or window.accel is None:
        absent = [name for name in ("gyro", "attitude", "accel") if getattr(window, name) is None]
        raise WindowError(f"window without {', '.join(absent)}", "gyro, attitude and accel for a subspace model")
    return window.rotor_speed**2, np.column_stack([window.gyro, _euler(window.attitude), window.accel])


def _euler(q: FloatArray) -> FloatArray:
    """Roll, pitch, yaw [rad] of quaternions body to world, shape (n, 3); yaw unwrapped over missing rows."""
    angles = euler(q)
    seen = np.isfinite(angles[:, 2])
    angles[seen, 2] = np.unwrap(angles[seen, 2])
    return angles
