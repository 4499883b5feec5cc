"""Sensors that read the motion, for many parameter vectors at once: IMU filter, AHRS, errors of the IMU.

The rows S_* hold what reaches the sensors at one sample; each stage works on them in place, and
`rollout_kernel.compare` ends the chain.
"""

import math

import numba as nb

from quadid.model import layout as ix
from quadid.types import FloatArray

# isort: off
from quadid.model.simd import (
    C_AB, C_AHRS, C_ATT_DELAY, C_EC, C_EC2, C_ES, C_ES2, C_GB, C_GS, C_KAPPA, C_R, C_SIGMA, C_VEL, C_VEL_Z, D_H, D_P,
    D_P0, D_Q, D_Q0, D_QW, D_QX, D_QY, D_QZ, D_R, D_R0, E_QW, E_QX, E_QY, E_QZ, F1_X, F2_X, G_BEND, G_DF, G_DW, G_F,
    G_F0, G_FM, G_W, G_W0, N_QW, N_QX, N_QY, N_QZ, S_BENDX, S_FX, S_FY, S_FZ, S_P, S_Q, S_QW, S_QX, S_QY, S_QZ, S_R,
    X_P, X_QW, X_QX, X_QY, X_QZ,
)  # fmt: skip

# isort: on
from quadid.model.simd import LANES, cached, exact, inlined, jit, lane_kernel

Y1, Y2 = LANES, 2 * LANES
"""Offsets of the second and third component of a vector."""


@nb.njit(**exact)
def _rotation(x, y, z, lane, s):  # type: ignore[no-untyped-def]
    """Writes exp([m]x) of a rotation vector m = (x, y, z), row by row from C_R (Rodrigues)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    # The quotients' series at small angles, where they lose digits.
    a = math.sin(angle) / angle if angle > 1e-2 else 1.0 - square / 6.0 * (1.0 - square / 20.0)
    b = (1.0 - math.cos(angle)) / square if angle > 1e-2 else 0.5 - square / 24.0 * (1.0 - square / 30.0)
    s[C_R + lane], s[C_R + Y1 + lane], s[C_R + Y2 + lane] = (
        1.0 - b * (y * y + z * z),
        b * x * y - a * z,
        b * x * z + a * y,
    )
    at = C_R + 3 * LANES + lane
    s[at], s[at + Y1], s[at + Y2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    at = C_R + 6 * LANES + lane
    s[at], s[at + Y1], s[at + Y2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@nb.njit(**exact)
def sensor_constants(theta: FloatArray, dt: float, s: FloatArray) -> None:
    """Derives the sensors' constants of all lanes from parameter vectors (LANES, size)."""
    for lane in range(LANES):
        th = theta[lane]
        # Butterworth poles at sigma (-1 +- i).  At period 0 both exponentials and kappa vanish: no filter.
        period = max(th[ix.IMU_PERIOD], 0.0)
        sigma = math.sqrt(2.0) * math.pi / max(period, 1e-7)
        s[C_SIGMA + lane], s[C_KAPPA + lane] = sigma, period / (math.sqrt(2.0) * math.pi)
        for row, h in ((C_EC, dt), (C_EC2, 0.5 * dt)):
            s[row + lane] = math.exp(-sigma * h) * math.cos(sigma * h)
            s[row + C_ES - C_EC + lane] = math.exp(-sigma * h) * math.sin(sigma * h)
        s[C_AHRS + lane] = -math.expm1(-dt * th[ix.AHRS_K])
        s[C_ATT_DELAY + lane] = max(th[ix.ATT_DELAY], 0.0) / dt
        for i in range(3):
            s[C_GB + i * LANES + lane], s[C_AB + i * LANES + lane] = th[ix.GBX + i], th[ix.ABX + i]
            s[C_GS + i * LANES + lane] = 1.0 + th[ix.GSX + i]
        s[C_VEL + lane], s[C_VEL_Z + lane] = 1.0 + th[ix.VEL_SCALE], 1.0 + th[ix.VEL_SCALE_Z]
        _rotation(th[ix.MAX_], th[ix.MAY], th[ix.MAZ], lane, s)


@nb.njit(**inlined)
def _follow(u0, u1, bend, y, dy, inv, kappa, sigma, c, e):  # type: ignore[no-untyped-def]
    """Value and derivative, after 1 / inv, of a Butterworth filter y'' + 2 sigma y' + 2 sigma^2 (y - u) = 0.

    The input is u0 + (u1 - u0 - bend) x + bend x^2 for x from 0 to 1; kappa = 1 / sigma in the same time.
    """
    first = (u1 - u0 - bend) * inv
    second = bend * inv * inv
    z = y - (u0 - kappa * first + kappa * kappa * second)
    dz = dy - (first - 2.0 * kappa * second)
    last = first + 2.0 * bend * inv
    y = u1 - kappa * last + kappa * kappa * second + z * (c + e) + dz * e * kappa
    return y, last - 2.0 * kappa * second + dz * (c - e) - 2.0 * sigma * z * e


@nb.njit(**jit)
def start_filter(dt: float, s: FloatArray) -> None:
    """Settles the IMU filter at the first step: on the rate's ramp, on the mean force."""
    lane_kernel()
    for i in range(0, 3 * LANES, LANES):
        for lane in range(LANES):
            slope = (s[X_P + i + lane] - s[S_P + i + lane]) / dt
            s[G_W + i + lane], s[G_DW + i + lane] = s[S_P + i + lane] - slope * s[C_KAPPA + lane], slope
            s[G_F + i + lane], s[G_DF + i + lane] = s[S_FX + i + lane], 0.0


@nb.njit(**jit)
def step_filter(dt: float, s: FloatArray) -> None:
    """Advances the IMU filter by one sample: rate quadratic over it, force linear over its halves."""
    lane_kernel()
    inv = 1.0 / dt
    for i in range(0, 3 * LANES, LANES):
        for lane in range(LANES):
            kappa, sigma = s[C_KAPPA + lane], s[C_SIGMA + lane]
            c, e = s[C_EC2 + lane], s[C_ES2 + lane]
            y, dy = _follow(
                s[G_W0 + i + lane],
                s[S_P + i + lane],
                s[G_BEND + i + lane],
                s[G_W + i + lane],
                s[G_DW + i + lane],
                inv,
                kappa,
                sigma,
                s[C_EC + lane],
                s[C_ES + lane],
            )
            middle = s[G_FM + i + lane]
            f, df = _follow(
                s[G_F0 + i + lane], middle, 0.0, s[G_F + i + lane], s[G_DF + i + lane], 2.0 * inv, kappa, sigma, c, e
            )
            f, df = _follow(middle, s[S_FX + i + lane], 0.0, f, df, 2.0 * inv, kappa, sigma, c, e)
            s[G_W + i + lane], s[G_DW + i + lane], s[G_F + i + lane], s[G_DF + i + lane] = y, dy, f, df


@nb.njit(**jit)
def use_filter(s: FloatArray) -> None:
    """Remembers this sample as the filter's input, and lets its output reach the sensors."""
    lane_kernel()
    for i in range(3 * LANES):
        s[G_W0 + i], s[G_F0 + i], s[G_BEND + i] = s[S_P + i], s[S_FX + i], s[S_BENDX + i]
        s[G_FM + i] = 0.5 * (s[F1_X + i] + s[F2_X + i])
        s[S_P + i], s[S_FX + i] = s[G_W + i], s[G_F + i]


@nb.njit(**inlined)
def _product(a0, a1, a2, a3, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """Hamilton product of two quaternions."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )


@nb.njit(**inlined)
def _turn(x, y, z):  # type: ignore[no-untyped-def]
    """Quaternion of the rotation vector (x, y, z), exact to the fifth order of the angle."""
    square = 0.25 * (x * x + y * y + z * z)
    half = 0.5 - square / 12.0 * (1.0 - square / 20.0)
    return 1.0 - square * (0.5 - square / 24.0), half * x, half * y, half * z


@nb.njit(**jit)
def step_tilt_error(s: FloatArray) -> None:
    """Advances the AHRS tilt error over a step: it turns towards the accelerometer's level with gain k.

    The filter adds k n x d to its body rate, n being down as the accelerometer sees it and d as the filter does
    (Mahony, Hamel & Pflimlin 2008, doi:10.1109/TAC.2008.923738).  Seen from the world, where its own turning drops
    out, the error turns by that, taken at the middle of the step, where the mean of the step's force belongs.  The
    pull fades while it turns, so the step's share is 1 - exp(-k dt) instead of k dt.
    """
    lane_kernel()
    for lane in range(LANES):
        q0, q1 = 0.5 * (s[S_QW + lane] + s[X_QW + lane]), 0.5 * (s[S_QX + lane] + s[X_QX + lane])
        q2, q3 = 0.5 * (s[S_QY + lane] + s[X_QY + lane]), 0.5 * (s[S_QZ + lane] + s[X_QZ + lane])
        scale = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)  # one Newton step to unit length
        e0, e1, e2, e3 = s[E_QW + lane], s[E_QX + lane], s[E_QY + lane], s[E_QZ + lane]
        q0, q1, q2, q3 = _product(e0, e1, e2, e3, q0 * scale, q1 * scale, q2 * scale, q3 * scale)
        dx, dy, dz = 2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2)
        nx = -0.5 * (s[F1_X + lane] + s[F2_X + lane])
        ny = -0.5 * (s[F1_X + Y1 + lane] + s[F2_X + Y1 + lane])
        nz = -0.5 * (s[F1_X + Y2 + lane] + s[F2_X + Y2 + lane])
        k = s[C_AHRS + lane] / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-9)
        x, y, z = k * (ny * dz - nz * dy), k * (nz * dx - nx * dz), k * (nx * dy - ny * dx)
        a, b, c = 2.0 * (q2 * z - q3 * y), 2.0 * (q3 * x - q1 * z), 2.0 * (q1 * y - q2 * x)
        x, y, z = x + q0 * a + q2 * c - q3 * b, y + q0 * b + q3 * a - q1 * c, z + q0 * c + q1 * b - q2 * a
        t0, t1, t2, t3 = _turn(x, y, z)
        e0, e1, e2, e3 = _product(t0, t1, t2, t3, e0, e1, e2, e3)
        s[N_QW + lane], s[N_QX + lane], s[N_QY + lane], s[N_QZ + lane] = e0, e1, e2, e3


@cached
def tilt_errors(
    gain: FloatArray, dt: float, attitude: FloatArray, force: FloatArray, s: FloatArray, out: FloatArray
) -> None:
    """Follows the AHRS tilt error along a whole flight.

    Args:
        gain: k of each lane [1/s], shape (LANES,).
        dt: step [s].
        attitude: unit quaternions, body to world, shape (n, 4).
        force: mean specific force over the step from each sample to the next [m/s^2], shape (n - 1, 3).
        s: work array of zeros, shape (N_ROWS * LANES,).
        out: tilt errors, quaternions in world axes, shape (LANES, n, 4); none at the begin.
    """
    for lane in range(LANES):
        s[C_AHRS + lane], s[E_QW + lane] = -math.expm1(-dt * gain[lane]), 1.0
        out[lane, 0, 0] = 1.0
    for i in range(len(force)):
        for lane in range(LANES):
            for c in range(4):
                s[S_QW + c * LANES + lane], s[X_QW + c * LANES + lane] = attitude[i, c], attitude[i + 1, c]
            for c in range(3):
                s[F1_X + c * LANES + lane] = s[F2_X + c * LANES + lane] = force[i, c]
        step_tilt_error(s)
        for lane in range(LANES):
            for c in range(4):
                s[E_QW + c * LANES + lane] = out[lane, i + 1, c] = s[N_QW + c * LANES + lane]


@nb.njit(**jit)
def tilt_attitude(s: FloatArray) -> None:
    """Turns the attitude that the AHRS reports by its tilt error, and takes up the error of the next sample."""
    lane_kernel()
    for lane in range(LANES):
        q0, q1, q2, q3 = _product(
            s[E_QW + lane],
            s[E_QX + lane],
            s[E_QY + lane],
            s[E_QZ + lane],
            s[S_QW + lane],
            s[S_QX + lane],
            s[S_QY + lane],
            s[S_QZ + lane],
        )
        s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane] = q0, q1, q2, q3
        s[E_QW + lane], s[E_QX + lane] = s[N_QW + lane], s[N_QX + lane]
        s[E_QY + lane], s[E_QZ + lane] = s[N_QY + lane], s[N_QZ + lane]


@nb.njit(**jit)
def remember_attitude(i: int, s: FloatArray, past: FloatArray) -> None:
    """Stores attitude and rate at step i of a segment in `past` (steps, 7, LANES)."""
    lane_kernel()
    for row in range(7):
        for lane in range(LANES):
            past[i, row, lane] = s[X_QW + row * LANES + lane]


@nb.njit(**jit)
def _look_up(back: int, i: int, dt: float, past: FloatArray, s: FloatArray) -> None:
    """Copies step `back` of the past for all lanes, and how far back from there each of them looks at step i."""
    lane_kernel()
    before = max(back - 1, 0)
    for row in range(7):
        for lane in range(LANES):
            s[D_QW + row * LANES + lane] = past[back, row, lane]
    for row in range(3):
        for lane in range(LANES):
            s[D_P0 + row * LANES + lane] = past[before, 4 + row, lane]
    for lane in range(LANES):
        s[D_H + lane] = (s[C_ATT_DELAY + lane] - (i - back)) * dt


@nb.njit(**jit)
def _look_up_each(i: int, dt: float, past: FloatArray, s: FloatArray) -> None:
    """As `_look_up` where lanes look back by different numbers of whole steps."""
    for lane in range(LANES):
        back = max(i - int(s[C_ATT_DELAY + lane]), 0)
        before = max(back - 1, 0)
        for row in range(7):
            s[D_QW + row * LANES + lane] = past[back, row, lane]
        for row in range(3):
            s[D_P0 + row * LANES + lane] = past[before, 4 + row, lane]
        s[D_H + lane] = (s[C_ATT_DELAY + lane] - (i - back)) * dt


@nb.njit(**jit)
def delay_attitude(i: int, dt: float, past: FloatArray, s: FloatArray) -> None:
    """Replaces the attitude that reaches the AHRS by that of step i less each lane's delay.

    Between stored steps, and before the first, attitude follows from rate and its backward difference.
    """
    whole = int(s[C_ATT_DELAY])
    alike = True
    for lane in range(LANES):
        alike &= int(s[C_ATT_DELAY + lane]) == whole
    if alike:
        _look_up(max(i - whole, 0), i, dt, past, s)
    else:
        _look_up_each(i, dt, past, s)
    _turn_back(dt, s)


@nb.njit(**jit)
def _turn_back(dt: float, s: FloatArray) -> None:
    lane_kernel()
    inv = 0.5 / dt
    for lane in range(LANES):
        h = s[D_H + lane]
        p, q, r = s[D_P + lane], s[D_Q + lane], s[D_R + lane]
        x = -h * (p - inv * (p - s[D_P0 + lane]) * h)
        y = -h * (q - inv * (q - s[D_Q0 + lane]) * h)
        z = -h * (r - inv * (r - s[D_R0 + lane]) * h)
        t0, t1, t2, t3 = _turn(x, y, z)
        q0, q1, q2, q3 = _product(s[D_QW + lane], s[D_QX + lane], s[D_QY + lane], s[D_QZ + lane], t0, t1, t2, t3)
        s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane] = q0, q1, q2, q3


@nb.njit(**jit)
def distort_imu(s: FloatArray) -> None:
    """Turns rate and force into the sensor's axes, scales the gyro, adds biases."""
    lane_kernel()
    for lane in range(LANES):
        r00, r01, r02 = s[C_R + lane], s[C_R + Y1 + lane], s[C_R + Y2 + lane]
        r10, r11, r12 = s[C_R + 3 * LANES + lane], s[C_R + 4 * LANES + lane], s[C_R + 5 * LANES + lane]
        r20, r21, r22 = s[C_R + 6 * LANES + lane], s[C_R + 7 * LANES + lane], s[C_R + 8 * LANES + lane]
        x, y, z = s[S_P + lane], s[S_Q + lane], s[S_R + lane]
        s[S_P + lane] = (r00 * x + r01 * y + r02 * z) * s[C_GS + lane] + s[C_GB + lane]
        s[S_Q + lane] = (r10 * x + r11 * y + r12 * z) * s[C_GS + Y1 + lane] + s[C_GB + Y1 + lane]
        s[S_R + lane] = (r20 * x + r21 * y + r22 * z) * s[C_GS + Y2 + lane] + s[C_GB + Y2 + lane]
        x, y, z = s[S_FX + lane], s[S_FY + lane], s[S_FZ + lane]
        s[S_FX + lane] = r00 * x + r01 * y + r02 * z + s[C_AB + lane]
        s[S_FY + lane] = r10 * x + r11 * y + r12 * z + s[C_AB + Y1 + lane]
        s[S_FZ + lane] = r20 * x + r21 * y + r22 * z + s[C_AB + Y2 + lane]
