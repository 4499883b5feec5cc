"""Extended Kalman filter of a multirotor with random forces: likelihood, frozen-gain innovations, smoother and score.

The random specific force f and angular acceleration alpha, and the attitude estimator's error e, are first-order
Gauss-Markov processes.  With x = (q, omega, v, f, alpha, e), body axes but for v, nu the innovations and S their
covariance, the likelihood of physics p and noise psi is

    -2 ln L = sum ln S + nu^2 / S                                                                             (1)

over scalar measurements, each after those before it.  Where outliers are expected, its noise has variance r / w, with a
weight w of each reading at the price k (w - 1 - ln w): Student-t noise of k degrees of freedom as a scale mixture
(Ting, Theodorou & Schaal 2007, doi:10.1007/978-3-540-74958-5_76; Lange, Little & Taylor 1989,
doi:10.1080/01621459.1989.10478852).  w = (k + 1) / (k + m) lowers the sum, m the mean of its squared error over r,
given all readings.

One step:
    q' = q (0, omega) / 2,  omega' = J^-1 (tau - omega x J omega) + tau_0 - damping omega + alpha             (2)
    v' = R (F / m + f) + g                                                                                    (3)
    a(t + h) = exp(-h / T) a(t) + n,  n ~ N(0, sigma^2 (1 - exp(-2 h / T))),  for a of f, alpha, e            (4)
    P <- F P F' + G Q G'                                                                                      (5)
where Q holds, beside the n, the noise of logged rotor speeds, which acts as forces and moments that change with every
sample, and that of readings is in the thrust that the accelerometer is compared with (r);
and for every scalar measurement y = h(x) + N(0, r / w):
    S = H P H' + r / w,  K = P H' / S,  x <- x + K nu,  P <- P - K S K'                                           (6)
backwards (Bryson & Frazier; de Jong 1989; no inverse of P, which random forces of size zero leave singular):
    u = nu / S - K' l,  l <- l + H u,  D = 1 / S + K' N K,  N <- (I - K H)' N (I - K H) + H H' / S            (7)
    l <- F' l,  N <- F' N F;   smoothed x = x + P l with covariance P - P N P                                 (8)
and the score (Koopman & Shephard 1992, doi:10.1093/biomet/79.4.823):
    d ln L / d r = (u^2 - D) / 2,  d ln L / d Q = G' (l l' - N) G / 2,  d ln L / d F = l x' - N F P           (9)

Sources: Jategaonkar, *Flight Vehicle System Identification*, 2nd ed., ch. 5 (filter error); Maine & Iliff, NASA
RP-1077 and RP-1138; Kristensen, Madsen & Jorgensen 2004, doi:10.1016/j.automatica.2003.10.001.
"""

import math
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from quadid.model.simd import jit, lane_kernel
from quadid.on_disk import kept
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY

# Error state: rotation vector, rate, velocity, random force, random angular acceleration, attitude error.
TH, OM, VE, FO, AL, AE, N = 0, 3, 6, 9, 12, 15, 18
# Mean: quaternion first, so everything after it lies one further.
N_MEAN = N + 1
# Scalar measurements: gyro, attitude (rotation vector), accelerometer, velocity.
GYRO, ATTITUDE, ACCEL, VELOCITY, M = 0, 3, 6, 9, 12
# Physics: the six, trim [rad/s^2], gyro bias, accelerometer bias, rotor drag [1/s], height above the hubs at which
# it acts [m], damping [1/s], centre of gravity [m], how late rotor speeds act and their first-order lag [s],
# share of its arm by which drag acts nearer to the centre of gravity than a hub, share of the gyroscopic coupling that
# a simulator leaves out, speed at which a rotor's thrust begins [rad/s] and what there is then [N], axial inflow [1/s].
B, D, JX, JY, JZ, JR, TRIM, GYRO_BIAS, ACCEL_BIAS, DRAG, TILTING, DAMP, CG, DELAY, LAG, CENTRAL, UNCOUPLED = (
    0, 1, 2, 3, 4, 5, 6, 9, 12, 15, 17, 19, 22, 24, 25, 26, 27,
)  # fmt: skip
DEAD, OFFSET, INFLOW, N_PHYSICS = 28, 29, 30, 31
# Noise: white of every scalar measurement; standard deviations of f (horizontal, vertical), alpha (roll and pitch,
# yaw), e (tilt, heading) and of logged rotor speeds [rad/s]; correlation times of f, f, alpha, alpha, e [s].
SIGMA, ROTOR, TIME, N_NOISE = M, M + 6, M + 7, M + 12
_GROUP = np.array([0, 0, 1, 2, 2, 3, 4, 4, 5])
"""Standard deviation of each Gauss-Markov state from FO on …"""
_CLOCK = np.array([0, 0, 1, 2, 2, 3, 4, 4, 4])
"""… and which correlation time."""
# Rotor moments over all rotors: thrust over b, and times x, y; squares of speed times spin; speeds times spin, speeds.
MOMENTS = 6
STILL_TIME = 1.0
"""Correlation time of a velocity that nobody measures [s]; see `Track.still`."""
_RULES = {"contract", "nsz"}
_fast: Any = kept(fastmath=_RULES)
_piece: Any = nb.njit(**(jit | {"fastmath": _RULES}))
"""Of a function for itself, without reference counts: the compiler makes better loops of it than inside a long one."""


class Beyond(NamedTuple):
    """Additions of a larger model to the filter's own equations, linear in rates and velocity; no rows: none.

    Attributes:
        added: to rate, rotation vector and velocity at the end of each step, to the measurements at its begin, shape
            (n, 9 + M).
        slope: derivative of what it adds in a step, to these nine and to the accelerometer at its end, by rates and
            velocity at its begin, shape (n, 12, 6).
        at: rates and velocity where it was linearised, shape (n, 6).
    """

    added: FloatArray
    slope: FloatArray
    at: FloatArray


def nothing_beyond() -> Beyond:
    """Additions to a filter with its own equations alone: none."""
    return Beyond(np.empty((0, 9 + M)), np.empty((0, 12, 6)), np.empty((0, 6)))


class Track(NamedTuple):
    """One stretch of flight: what was measured when, and what the rotors did meanwhile.

    Attributes:
        t: times of measurements [s], shape (n,), rising.
        y: gyro [rad/s], quaternion, accelerometer [m/s^2], velocity [m/s], shape (n, 13).
        seen: whether each of the four was measured then, shape (n, 4).
        half: half the time over which the accelerometer averages, centred on t [s].
        piece_t: where the pieces begin on which rotor speeds are straight lines, shape (pieces,).
        speed: of each rotor at the begin of a piece [rad/s], and how fast it rises, shape (pieces, rotors, 2).
        share: of each rotor's square in the first four moments, shape (4, rotors).
        mass: [kg].
        rotors: number of rotors.
        hubs: means of x^2, y^2 [m^2] and z [m] of their hubs in body axes, from the centre of gravity.
        waver: see `track.wavering`.
        period: time between rotor samples [s].
        read: whether they are readings: only the noise of a reading is no thrust.
        speed_noise: least and most standard deviation of a logged rotor speed [rad/s].
        still: standard deviation of a velocity that nobody measures [m/s]; 0: velocity plays no part.
        weight: w of every scalar measurement, shape (n, M); no rows: none is held.
        beyond: what a larger model adds, see `whole_model`.
    """

    t: FloatArray
    y: FloatArray
    seen: BoolArray
    half: float
    piece_t: FloatArray
    speed: FloatArray
    share: FloatArray
    mass: float
    rotors: int
    hubs: tuple[float, float, float]
    waver: FloatArray
    period: float
    read: bool
    speed_noise: tuple[float, float]
    still: float
    weight: FloatArray
    beyond: Beyond


class Gains(NamedTuple):
    """Results of a filter pass that innovations under its gains, the smoother and the score need.

    Attributes:
        gain: K of each scalar measurement, shape (n, M, N).
        nu, S, w: innovation, its variance (0: not measured), weight of its reading, shapes (n, M).
        slope: derivative of the accelerometer by rotation vector, velocity and alpha, shape (n, 3, 9).
        mean: after the updates, shape (n, N_MEAN).
        P: columns of the covariance there that belong to f, alpha, e, shape (n, N, 9).
        table: rotor moments, see `moments`.
        made_with: arguments of `moments`.
        beyond: see `Track.beyond`.
    """

    gain: FloatArray
    nu: FloatArray
    S: FloatArray
    w: FloatArray
    slope: FloatArray
    mean: FloatArray
    P: FloatArray
    table: FloatArray
    made_with: tuple[float, float, float, float]
    beyond: Beyond


@_fast
def _courses(track: Track, lag: float, dead: float, over: float) -> FloatArray:
    """Integral of every rotor moment up to each piece, and its course from there, shape (pieces, MOMENTS, 7).

    Behind a first-order lag T a rotor that should turn at u + r s turns at y = a + r s + c exp(-s / T), a = u - r T.
    The integrals of y and y^2 are a cubic in s and three decays, see `_integral`; the lag forgets what was before.
    """
    pieces, rotors = track.speed.shape[0], track.speed.shape[1]
    out, turning = np.zeros((pieces, MOMENTS, 7)), track.speed[0, :, 0].copy()
    for k in range(pieces):
        s = track.piece_t[k + 1] - track.piece_t[k] if k + 1 < pieces else 0.0
        decays, fade = _decays(lag, s), math.exp(-s / lag) if lag > 0.0 else 0.0
        for i in range(rotors):
            r = track.speed[k, i, 1]
            a = track.speed[k, i, 0] - lag * r
            c = turning[i] - a if lag > 0.0 else 0.0
            for m in range(4):
                w, above = track.share[m, i], a - dead if m < 3 else a
                out[k, m, 1] += w * (above * above + (over if m < 3 else 0.0))
                out[k, m, 2] += w * above * r
                out[k, m, 3] += w * r * r / 3.0
                out[k, m, 4] += 2.0 * w * above * c
                out[k, m, 5] += 2.0 * w * r * c
                out[k, m, 6] += w * c * c
            for m in range(4, MOMENTS):
                w = track.share[3 if m == 4 else 0, i]
                out[k, m, 1] += w * a
                out[k, m, 2] += 0.5 * w * r
                out[k, m, 4] += w * c
            turning[i] = a + r * s + c * fade
        for m in range(MOMENTS):
            if k + 1 < pieces:
                out[k + 1, m, 0] = _integral(out[k, m], s, decays)
    return out


@_piece
def _decays(lag: float, s: float) -> tuple[float, float, float]:
    """Integrals of exp(-r / T), r exp(-r / T) and exp(-2 r / T) over r from 0 to s; none without a lag T."""
    if not (lag > 0.0 and s > 0.0):
        return 0.0, 0.0, 0.0
    fade = math.exp(-s / lag)
    gone = lag * (1.0 - fade)
    return gone, lag * (gone - s * fade), 0.5 * lag * (1.0 - fade * fade)


@_piece
def _integral(course: FloatArray, s: float, decays: tuple[float, float, float]) -> float:
    """Integral of a moment up to s after the begin of a piece."""
    total = course[0] + s * (course[1] + s * (course[2] + s * course[3]))
    return float(total + decays[0] * course[4] + decays[1] * course[5] + decays[2] * course[6])


@_piece
def _integrals(piece_t: FloatArray, courses: FloatArray, lag: float, t: float, at: int, out: FloatArray) -> int:
    """Writes the integral of every moment up to time t; returns its piece, looked for from piece `at` on."""
    while at > 0 and piece_t[at] > t:
        at -= 1
    while at + 1 < len(piece_t) and piece_t[at + 1] <= t:
        at += 1
    decays = _decays(lag, t - piece_t[at])
    for m in range(MOMENTS):
        out[m] = _integral(courses[at, m], t - piece_t[at], decays)
    return at


@_fast
def moments(track: Track, delay: float, lag: float, dead: float, over: float) -> FloatArray:
    """Mean rotor moments, shape (n, 3 MOMENTS): both halves of the step from each time; while the accelerometer reads.

    Args:
        track: the flight.
        delay: by which rotor speeds act later than the log has them [s].
        lag: with which they follow [s].
        dead: speed at which thrust begins [rad/s].
        over: thrust there, over b [rad^2/s^2].
    """
    courses = _courses(track, lag, dead, over)
    n = len(track.t)
    out = np.zeros((n, 3 * MOMENTS))
    a, b, c = np.empty(MOMENTS), np.empty(MOMENTS), np.empty(MOMENTS)
    d, e = np.empty(MOMENTS), np.empty(MOMENTS)
    at = 0
    at = _integrals(track.piece_t, courses, lag, track.t[0] - delay, at, a)
    for k in range(n):
        t = track.t[k] - delay
        _integrals(track.piece_t, courses, lag, t - track.half, at, d)
        _integrals(track.piece_t, courses, lag, t + track.half, at, e)
        for m in range(MOMENTS):
            out[k, 2 * MOMENTS + m] = (e[m] - d[m]) / (2.0 * track.half)
        if k + 1 < n:
            h = 0.5 * (track.t[k + 1] - track.t[k])
            at = _integrals(track.piece_t, courses, lag, t + h, at, b)
            at = _integrals(track.piece_t, courses, lag, t + 2.0 * h, at, c)
            for m in range(MOMENTS):
                out[k, m], out[k, MOMENTS + m] = (b[m] - a[m]) / h, (c[m] - b[m]) / h
                a[m] = c[m]
    return out


def turning(p: FloatArray) -> tuple[float, float, float, float]:
    """Arguments of `moments` at physics p."""
    return p[DELAY], p[LAG], p[DEAD], p[OFFSET] / p[B]


@_fast
def _constants(p: FloatArray, track: Track) -> FloatArray:
    """Constants of Eqs. 2 and 3."""
    c = np.empty(30)
    hover = p[DEAD] + math.sqrt(max(track.mass * GRAVITY / track.rotors - p[OFFSET], 1e-9) / p[B])
    c[0], c[1], c[2], c[3] = p[B] / track.mass, p[B] / p[JX], p[B] / p[JY], p[D] / p[JZ]
    c[4], c[5] = p[JR] / p[JX], p[JR] / p[JY]
    c[6], c[7], c[8] = (p[JY] - p[JZ]) / p[JX], (p[JZ] - p[JX]) / p[JY], (p[JX] - p[JY]) / p[JZ]
    for i in range(6, 9):
        c[i] *= 1.0 - p[UNCOUPLED]
    c[9], c[10], c[11] = p[TRIM], p[TRIM + 1], p[TRIM + 2]
    c[12], c[13] = p[DRAG] / (track.rotors * hover), p[DRAG + 1] / (track.rotors * hover)
    c[14], c[15], c[16] = p[DAMP], p[DAMP + 1], p[DAMP + 2]
    c[17], c[18] = p[CG], p[CG + 1]
    # Drag acts at the hubs: as high as they are, against their own motion in a turn, more where a rotor turns faster.
    xx, yy, z = track.hubs
    share = 1.0 - p[CENTRAL]
    c[19] = track.mass * (p[TILTING] - share * z) * c[12] / p[JY]
    c[20] = track.mass * (p[TILTING + 1] - share * z) * c[13] / p[JX]
    c[21] = track.mass * share**2 * (yy * c[12] + xx * c[13]) / p[JZ]
    c[22], c[23], c[24] = track.mass * share / p[JZ], 0.5 * track.rotors, track.rotors * p[DEAD]
    c[25] = p[INFLOW] / (track.rotors * hover)
    c[26], c[27] = track.mass * c[25] / p[JX], track.mass * c[25] / p[JY]
    c[28], c[29] = c[26] * yy, c[27] * xx
    return c


@_piece
def _turning(c, s2, x2, y2, z2, o1, s1, p, q, r):  # type: ignore[no-untyped-def]
    """Eq. 2 without alpha: angular acceleration for these rotor moments and rates."""
    return (
        c[6] * q * r + c[1] * (c[18] * s2 - y2) + c[4] * o1 * q - (c[14] + c[28] * s1) * p + c[9],
        c[7] * p * r + c[2] * (x2 - c[17] * s2) - c[5] * o1 * p - (c[15] + c[29] * s1) * q + c[10],
        c[8] * p * q + c[3] * z2 - (c[16] + c[21] * s1) * r + c[11],
    )


@_piece
def _dragged(c, x2, y2, s1, u, v, w):  # type: ignore[no-untyped-def]
    """Angular acceleration by drag and inflow at the hubs, at velocity u, v, w in body axes."""
    # Sums of x and y times speed about the centre of gravity: of squares over twice the mean speed; 0 at rest.
    each = c[23] / (s1 - c[24]) if s1 > max(c[24], 0.0) else 0.0
    x1, y1 = each * x2 - c[17] * s1, each * y2 - c[18] * s1
    roll, pitch = -c[20] * s1 * v - c[26] * w * y1, c[19] * s1 * u + c[27] * w * x1
    return roll, pitch, c[22] * (c[12] * u * y1 - c[13] * v * x1)


@_piece
def _rotation(w, x, y, z):  # type: ignore[no-untyped-def]
    """Body to world, row by row."""
    return (
        w * w + x * x - y * y - z * z,
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        w * w - x * x + y * y - z * z,
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        w * w - x * x - y * y + z * z,
    )


@_piece
def _force(c, s2, s1, w, x, y, z, vn, ve, vd):  # type: ignore[no-untyped-def]
    """Specific force of rotors and drag in body axes, and velocity there."""
    r = _rotation(w, x, y, z)
    u, v = r[0] * vn + r[3] * ve + r[6] * vd, r[1] * vn + r[4] * ve + r[7] * vd
    down = r[2] * vn + r[5] * ve + r[8] * vd
    return -c[12] * s1 * u, -c[13] * s1 * v, -c[0] * s2 - c[25] * s1 * down, u, v, down


@_piece
def _falling(c, s2, s1, w, x, y, z, vn, ve, vd, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Eq. 3."""
    r = _rotation(w, x, y, z)
    ax, ay, az, _, _, _ = _force(c, s2, s1, w, x, y, z, vn, ve, vd)
    ax, ay, az = ax + fx, ay + fy, az + fz
    return (
        r[0] * ax + r[1] * ay + r[2] * az,
        r[3] * ax + r[4] * ay + r[5] * az,
        r[6] * ax + r[7] * ay + r[8] * az + GRAVITY,
    )


@_piece
def _spin(w, x, y, z, p, q, r):  # type: ignore[no-untyped-def]
    """Eq. 2: rate of the quaternion."""
    return (
        0.5 * (-x * p - y * q - z * r),
        0.5 * (w * p + y * r - z * q),
        0.5 * (w * q + z * p - x * r),
        0.5 * (w * r + x * q - y * p),
    )


@_piece
def _advance(c: FloatArray, row: FloatArray, h: float, keep: FloatArray, air: bool, x: FloatArray) -> None:
    """Eqs. 2 to 4 over one step: classical Runge-Kutta, rotor moments linear through their means over both halves.

    Args:
        c: see `_constants`.
        row: of the table of moments.
        h: step [s].
        keep: exp(-h / T) of every Gauss-Markov state.
        air: whether velocity plays a part.
        x: mean, advanced in place.
    """
    half = 0.5 * h
    s2, x2, y2 = 0.5 * (row[0] + row[MOMENTS]), 0.5 * (row[1] + row[MOMENTS + 1]), 0.5 * (row[2] + row[MOMENTS + 2])
    z2, o1 = 0.5 * (row[3] + row[MOMENTS + 3]), 0.5 * (row[4] + row[MOMENTS + 4])
    s1 = 0.5 * (row[5] + row[MOMENTS + 5])
    ds, dx, dy = row[0] - row[MOMENTS], row[1] - row[MOMENTS + 1], row[2] - row[MOMENTS + 2]
    dz, do = row[3] - row[MOMENTS + 3], row[4] - row[MOMENTS + 4]
    # Mean over the step of a Gauss-Markov process without its noise; the moment of drag as at the step's begin.
    gx = 0.5 * (1.0 + keep[3]) * x[AL + 1]
    gy = 0.5 * (1.0 + keep[4]) * x[AL + 2]
    gz = 0.5 * (1.0 + keep[5]) * x[AL + 3]
    if air:
        _, _, _, u, v, w = _force(c, s2, s1, x[0], x[1], x[2], x[3], x[VE + 1], x[VE + 2], x[VE + 3])
        dp, dq, dr = _dragged(c, x2, y2, s1, u, v, w)
        gx, gy, gz = gx + dp, gy + dq, gz + dr
    qw, qx, qy, qz, p, q, r = x[0], x[1], x[2], x[3], x[4], x[5], x[6]
    a1, b1, c1 = _turning(c, s2 + ds, x2 + dx, y2 + dy, z2 + dz, o1 + do, s1, p, q, r)
    a1, b1, c1 = a1 + gx, b1 + gy, c1 + gz
    k1 = _spin(qw, qx, qy, qz, p, q, r)
    p2, q2, r2 = p + half * a1, q + half * b1, r + half * c1
    a2, b2, c2 = _turning(c, s2, x2, y2, z2, o1, s1, p2, q2, r2)
    a2, b2, c2 = a2 + gx, b2 + gy, c2 + gz
    w2, x2_, y2_, z2_ = qw + half * k1[0], qx + half * k1[1], qy + half * k1[2], qz + half * k1[3]
    k2 = _spin(w2, x2_, y2_, z2_, p2, q2, r2)
    p3, q3, r3 = p + half * a2, q + half * b2, r + half * c2
    a3, b3, c3 = _turning(c, s2, x2, y2, z2, o1, s1, p3, q3, r3)
    a3, b3, c3 = a3 + gx, b3 + gy, c3 + gz
    w3, x3, y3, z3 = qw + half * k2[0], qx + half * k2[1], qy + half * k2[2], qz + half * k2[3]
    k3 = _spin(w3, x3, y3, z3, p3, q3, r3)
    p4, q4, r4 = p + h * a3, q + h * b3, r + h * c3
    a4, b4, c4 = _turning(c, s2 - ds, x2 - dx, y2 - dy, z2 - dz, o1 - do, s1, p4, q4, r4)
    a4, b4, c4 = a4 + gx, b4 + gy, c4 + gz
    w4, x4, y4, z4 = qw + h * k3[0], qx + h * k3[1], qy + h * k3[2], qz + h * k3[3]
    k4 = _spin(w4, x4, y4, z4, p4, q4, r4)
    sixth = h / 6.0
    if air:
        d1 = row[5] - row[MOMENTS + 5]
        fx = 0.5 * (1.0 + keep[0]) * x[FO + 1]
        fy = 0.5 * (1.0 + keep[1]) * x[FO + 2]
        fz = 0.5 * (1.0 + keep[2]) * x[FO + 3]
        n, e, d = x[VE + 1], x[VE + 2], x[VE + 3]
        n1, e1, f1 = _falling(c, s2 + ds, s1 + d1, qw, qx, qy, qz, n, e, d, fx, fy, fz)
        n2, e2, f2 = _falling(c, s2, s1, w2, x2_, y2_, z2_, n + half * n1, e + half * e1, d + half * f1, fx, fy, fz)
        n3, e3, f3 = _falling(c, s2, s1, w3, x3, y3, z3, n + half * n2, e + half * e2, d + half * f2, fx, fy, fz)
        n4, e4, f4 = _falling(c, s2 - ds, s1 - d1, w4, x4, y4, z4, n + h * n3, e + h * e3, d + h * f3, fx, fy, fz)
        x[VE + 1] = n + sixth * (n1 + 2.0 * (n2 + n3) + n4)
        x[VE + 2] = e + sixth * (e1 + 2.0 * (e2 + e3) + e4)
        x[VE + 3] = d + sixth * (f1 + 2.0 * (f2 + f3) + f4)
    qw += sixth * (k1[0] + 2.0 * (k2[0] + k3[0]) + k4[0])
    qx += sixth * (k1[1] + 2.0 * (k2[1] + k3[1]) + k4[1])
    qy += sixth * (k1[2] + 2.0 * (k2[2] + k3[2]) + k4[2])
    qz += sixth * (k1[3] + 2.0 * (k2[3] + k3[3]) + k4[3])
    scale = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    x[0], x[1], x[2], x[3] = qw * scale, qx * scale, qy * scale, qz * scale
    x[4] = p + sixth * (a1 + 2.0 * (a2 + a3) + a4)
    x[5] = q + sixth * (b1 + 2.0 * (b2 + b3) + b4)
    x[6] = r + sixth * (c1 + 2.0 * (c2 + c3) + c4)
    for i in range(9):
        x[FO + 1 + i] *= keep[i]


@_piece
def _step_beyond(beyond: Beyond, k: int, x: FloatArray, out: FloatArray) -> None:
    """Writes what a larger model adds in step k from mean x, shape (12,)."""
    if len(beyond.added) > 0:
        for i in range(12):
            out[i] = beyond.added[k, i] if i < 9 else 0.0
            for j in range(6):
                out[i] += beyond.slope[k, i, j] * (x[4 + j] - beyond.at[k, j])


@_piece
def _go_beyond(beyond: Beyond, step: FloatArray, room: FloatArray, x: FloatArray) -> None:
    """Adds a `step` of a larger model to the mean after it; `room` (N,) is overwritten."""
    if len(beyond.added) > 0:
        room[:] = 0.0
        for i in range(3):
            room[OM + i], room[TH + i], room[VE + i] = step[i], step[3 + i], step[6 + i]
        _correct(room, x)


@_piece
def _read_beyond(beyond: Beyond, k: int, step: FloatArray, nu: FloatArray) -> None:
    """Takes what a larger model makes of the measurements off the innovations of row k, after a `step` up to there."""
    if len(beyond.added) > 0:
        for m in range(M):
            nu[m] -= beyond.added[k, 9 + m]
        for i in range(3):
            nu[ACCEL + i] -= step[9 + i]


@_piece
def _sense_beyond(beyond: Beyond, k: int, slope: FloatArray) -> None:
    """Adds to `_accel_slope` what a larger model makes of the accelerometer at the end of step k, by velocity."""
    if len(beyond.added) > 0 and k >= 0:
        for i in range(3):
            for j in range(3):
                slope[i, 3 + j] += beyond.slope[k, 9 + i, 3 + j]


@_piece
def _bend(beyond: Beyond, k: int, F: FloatArray) -> None:
    """Adds the slope of what a larger model makes of step k to F of Eq. 5."""
    if len(beyond.added) > 0:
        for i in range(3):
            for j in range(6):
                F[OM + i, OM + j] += beyond.slope[k, i, j]
                F[TH + i, OM + j] += beyond.slope[k, 3 + i, j]
                F[VE + i, OM + j] += beyond.slope[k, 6 + i, j]


@_piece
def _expected(c, p, y, seen, row, air, x, out):  # type: ignore[no-untyped-def]
    """Writes y - h(x) of what was measured, shape (M,), a rotation vector of the attitude."""
    for i in range(3):
        out[GYRO + i] = y[i] - x[4 + i] - p[GYRO_BIAS + i]
    if seen[1]:
        w = x[0] * y[3] + x[1] * y[4] + x[2] * y[5] + x[3] * y[6]
        a = x[0] * y[4] - x[1] * y[3] - x[2] * y[6] + x[3] * y[5]
        b = x[0] * y[5] + x[1] * y[6] - x[2] * y[3] - x[3] * y[4]
        e = x[0] * y[6] - x[1] * y[5] + x[2] * y[4] - x[3] * y[3]
        sine = math.sqrt(a * a + b * b + e * e)
        scale = (
            (2.0 if w >= 0.0 else -2.0)
            if sine < 1e-9
            else 2.0 * math.atan2(sine, abs(w)) / sine * (1.0 if w >= 0.0 else -1.0)
        )
        out[ATTITUDE] = scale * a - x[AE + 1]
        out[ATTITUDE + 1] = scale * b - x[AE + 2]
        out[ATTITUDE + 2] = scale * e - x[AE + 3]
    reading = 2 * MOMENTS
    s2, x2, y2 = row[reading], row[reading + 1], row[reading + 2]
    z2, o1, s1 = row[reading + 3], row[reading + 4], row[reading + 5]
    fx, fy, fz, u, v, w = 0.0, 0.0, -c[0] * s2, 0.0, 0.0, 0.0
    if air:
        fx, fy, fz, u, v, w = _force(c, s2, s1, x[0], x[1], x[2], x[3], x[VE + 1], x[VE + 2], x[VE + 3])
    rx, ry = -c[17], -c[18]
    if rx != 0.0 or ry != 0.0:
        # The IMU is fixed to the frame, at r from the centre of gravity: omega' x r + omega x (omega x r).
        p_, q_, r_ = x[4], x[5], x[6]
        dp, dq, dr = _turning(c, s2, x2, y2, z2, o1, s1, p_, q_, r_)
        ap, aq, ar = _dragged(c, x2, y2, s1, u, v, w)
        ap, aq, ar = ap + dp + x[AL + 1], aq + dq + x[AL + 2], ar + dr + x[AL + 3]
        along, square = p_ * rx + q_ * ry, p_ * p_ + q_ * q_ + r_ * r_
        fx += p_ * along - rx * square - ar * ry
        fy += q_ * along - ry * square + ar * rx
        fz += r_ * along + ap * ry - aq * rx
    out[ACCEL] = y[7] - fx - x[FO + 1] - p[ACCEL_BIAS]
    out[ACCEL + 1] = y[8] - fy - x[FO + 2] - p[ACCEL_BIAS + 1]
    out[ACCEL + 2] = y[9] - fz - x[FO + 3] - p[ACCEL_BIAS + 2]
    for i in range(3):
        out[VELOCITY + i] = (y[10 + i] if seen[3] else 0.0) - x[VE + 1 + i]


@_piece
def _correct(dx: FloatArray, x: FloatArray) -> None:
    """X <- x + dx, the attitude by its rotation vector."""
    a, b, e = 0.5 * dx[0], 0.5 * dx[1], 0.5 * dx[2]
    square = a * a + b * b + e * e
    sinc, cosine = 1.0 - square / 6.0 * (1.0 - square / 20.0), 1.0 - square / 2.0 * (1.0 - square / 12.0)
    a, b, e = sinc * a, sinc * b, sinc * e
    qw, qx, qy, qz = x[0], x[1], x[2], x[3]
    w = qw * cosine - qx * a - qy * b - qz * e
    i = qw * a + qx * cosine + qy * e - qz * b
    j = qw * b - qx * e + qy * cosine + qz * a
    k = qw * e + qx * b - qy * a + qz * cosine
    scale = 1.0 / math.sqrt(w * w + i * i + j * j + k * k)
    x[0], x[1], x[2], x[3] = scale * w, scale * i, scale * j, scale * k
    for m in range(3, N):
        x[m + 1] += dx[m]


@_fast
def _start(track: Track, p: FloatArray) -> FloatArray:
    """First mean: as first measured, else level and at rest or where a larger model is linearised; P is wide."""
    x = np.zeros(N_MEAN)
    x[0] = 1.0
    if len(track.beyond.added) > 0:
        for i in range(3):
            x[VE + 1 + i] = track.beyond.at[0, 3 + i]
    for group in range(4):
        for k in range(len(track.t)):
            if track.seen[k, group]:
                for i in range(3):
                    if group == 0:
                        x[4 + i] = track.y[k, i] - p[GYRO_BIAS + i]
                    elif group == 1:
                        x[i], x[3] = track.y[k, 3 + i], track.y[k, 6]
                    elif group == 3:
                        x[VE + 1 + i] = track.y[k, 10 + i]
                break
    return x


@_piece
def _copy(source: FloatArray, target: FloatArray) -> None:
    """Copies a mean; a loop, because an assignment of arrays compiles a check of their shapes and its message."""
    for i in range(N_MEAN):
        target[i] = source[i]


@_piece
def _in_air(track: Track) -> bool:
    """Checks whether velocity plays a part."""
    air = track.still > 0.0
    for k in range(len(track.t)):
        air |= track.seen[k, 3]
    return air


@_piece
def _keep(psi: FloatArray, h: float, keep: FloatArray) -> None:
    for i in range(9):
        keep[i] = math.exp(-h / psi[TIME + _CLOCK[i]])


@_piece
def _cross(a, b, e, scale, row, col, F):  # type: ignore[no-untyped-def]
    """Adds scale [(a, b, e)]x to a block of F."""
    F[row, col + 1] -= scale * e
    F[row, col + 2] += scale * b
    F[row + 1, col] += scale * e
    F[row + 1, col + 2] -= scale * a
    F[row + 2, col] -= scale * b
    F[row + 2, col + 1] += scale * a


@_piece
def _transition(c, row, h, keep, air, x, after, F, turn):  # type: ignore[no-untyped-def]
    """Writes F of Eq. 5, from a step's begin and end, and the rotation in its middle (3, 3)."""
    F[:] = 0.0
    p, q, r = 0.5 * (x[4] + after[4]), 0.5 * (x[5] + after[5]), 0.5 * (x[6] + after[6])
    o1, s1 = 0.5 * (row[4] + row[MOMENTS + 4]), 0.5 * (row[5] + row[MOMENTS + 5])
    A = (
        (-c[14] - c[28] * s1, c[6] * r + c[4] * o1, c[6] * q),
        (c[7] * r - c[5] * o1, -c[15] - c[29] * s1, c[7] * p),
        (c[8] * q, c[8] * p, -c[16] - c[21] * s1),
    )
    turned = (h * p, h * q, h * r)
    square = turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2
    for i in range(3):
        F[TH + i, TH + i] = 1.0 - 0.5 * square
        for j in range(3):
            F[TH + i, TH + j] += 0.5 * turned[i] * turned[j]
            F[TH + i, OM + j] = 0.5 * h * h * A[i][j]
            F[OM + i, OM + j] = h * A[i][j]
            F[OM + i, AL + j] = 0.25 * h * h * (1.0 + keep[3 + j]) * A[i][j]
            for m in range(3):
                F[OM + i, OM + j] += 0.5 * h * h * A[i][m] * A[m][j]
        F[TH + i, OM + i] += h
        F[OM + i, OM + i] += 1.0
        F[OM + i, AL + i] += 0.5 * h * (1.0 + keep[3 + i])
        F[TH + i, AL + i] = 0.25 * h * h * (1.0 + keep[3 + i])
    _cross(turned[0], turned[1], turned[2], -1.0, TH, TH, F)
    _cross(turned[0], turned[1], turned[2], -0.5 * h, TH, OM, F)
    for i in range(9):
        F[FO + i, FO + i] = keep[i]
    if air:
        w, a, b, e = x[0] + after[0], x[1] + after[1], x[2] + after[2], x[3] + after[3]
        sign = 1.0 if w * x[0] + a * x[1] + b * x[2] + e * x[3] > 0.0 else -1.0
        if sign < 0.0:
            w, a, b, e = x[0] - after[0], x[1] - after[1], x[2] - after[2], x[3] - after[3]
        scale = 1.0 / math.sqrt(w * w + a * a + b * b + e * e)
        R = _rotation(scale * w, scale * a, scale * b, scale * e)
        s2, s1 = 0.5 * (row[0] + row[MOMENTS]), 0.5 * (row[5] + row[MOMENTS + 5])
        fx, fy, fz, u, v, down = _force(
            c,
            s2,
            s1,
            scale * w,
            scale * a,
            scale * b,
            scale * e,
            0.5 * (x[VE + 1] + after[VE + 1]),
            0.5 * (x[VE + 2] + after[VE + 2]),
            0.5 * (x[VE + 3] + after[VE + 3]),
        )
        fx, fy, fz = fx + x[FO + 1], fy + x[FO + 2], fz + x[FO + 3]
        kx, ky, kz = c[12] * s1, c[13] * s1, c[25] * s1
        # d force / d rotation vector = -[force]x - k [velocity]x, in body axes.
        B = ((0.0, fz + kx * down, -fy - kx * v), (-fz - ky * down, 0.0, fx + ky * u), (fy + kz * v, -fx - kz * u, 0.0))
        for i in range(3):
            for j in range(3):
                turn[i, j] = R[3 * i + j]
                F[VE + i, FO + j] = 0.5 * h * (1.0 + keep[j]) * R[3 * i + j]
                F[VE + i, VE + j] = -h * (
                    kx * R[3 * i] * R[3 * j] + ky * R[3 * i + 1] * R[3 * j + 1] + kz * R[3 * i + 2] * R[3 * j + 2]
                )
                for m in range(3):
                    F[VE + i, TH + j] += h * R[3 * i + m] * B[m][j]
            F[VE + i, VE + i] += 1.0
        # d (body velocity x, y) / d rotation vector and velocity, of which drag makes a moment.
        along = ((0.0, -down, v), (down, 0.0, -u))
        for j in range(3):
            for i in range(3):
                F[VE + i, OM + j] = 0.5 * h * F[VE + i, TH + j]
            F[OM, TH + j] -= h * c[20] * s1 * along[1][j]
            F[OM + 1, TH + j] += h * c[19] * s1 * along[0][j]
            F[OM, VE + j] -= h * c[20] * s1 * R[3 * j + 1]
            F[OM + 1, VE + j] += h * c[19] * s1 * R[3 * j]
    else:
        for i in range(3):
            F[VE + i, VE + i] = 1.0


@_piece
def _kick(h, air, i, turn, where, what):  # type: ignore[no-untyped-def]
    """Writes places and values of G in Eq. 5 of Gauss-Markov state i, whose noise acts by half within the step.

    Returns how many there are; its own place is the first.
    """
    where[0], what[0] = FO + i, 1.0
    if i < 3 and air:
        for j in range(3):
            where[1 + j], what[1 + j] = VE + j, 0.5 * h * turn[j, i]
        return 4
    if 3 <= i < 6:
        where[1], what[1] = OM + i - 3, 0.5 * h
        where[2], what[2] = TH + i - 3, h * h / 6.0
        return 3
    return 1


@_piece
def _wavering(track, row, h, out):  # type: ignore[no-untyped-def]
    """Writes what rotor speeds of noise 1 rad/s make of the specific thrust and the angular accelerations of a step.

    Variances, shape (4,).  A sample acts for `period`, so its noise adds up over longer steps as a random walk does.
    """
    for i in range(4):
        out[i] = 2.0 * (row[0] + row[MOMENTS]) * track.period / h * track.waver[i]


@_piece
def _push(h, air, i, turn, where, what):  # type: ignore[no-untyped-def]
    """Writes places and values of G of rotor noise `i` of `_wavering`, constant over the step; returns how many."""
    if i > 0:
        where[0], what[0] = OM + i - 1, h
        where[1], what[1] = TH + i - 1, 0.5 * h * h
        return 2
    if air:
        for j in range(3):
            where[j], what[j] = VE + j, h * turn[j, 2]
        return 3
    return 0


@_piece
def _widen(q, count, where, what, P):  # type: ignore[no-untyped-def]
    """Adds G q G' to P."""
    root = math.sqrt(q)
    for a in range(count):
        what[a] *= root
    for a in range(count):
        for b in range(count):
            P[where[a], where[b]] += what[a] * what[b]


@_piece
def _sensors(H: FloatArray) -> None:
    """Writes H of Eq. 6, shape (M, N), but for the slope of the accelerometer."""
    H[:] = 0.0
    for i in range(3):
        H[GYRO + i, OM + i] = H[ATTITUDE + i, TH + i] = H[ATTITUDE + i, AE + i] = 1.0
        H[ACCEL + i, FO + i] = H[VELOCITY + i, VE + i] = 1.0


@_piece
def _sense(slope: FloatArray, H: FloatArray) -> None:
    """Writes the slope of the accelerometer to H."""
    for i in range(3):
        for j in range(3):
            H[ACCEL + i, TH + j] = slope[i, j]
            H[ACCEL + i, VE + j] = slope[i, 3 + j]
            H[ACCEL + i, AL + j] = slope[i, 6 + j]


@_piece
def _seen(m: int, slope: FloatArray, x: FloatArray) -> float:
    """H x of scalar measurement m."""
    axis = m % 3
    if m < ATTITUDE:
        return float(x[OM + axis])
    if m < ACCEL:
        return float(x[TH + axis] + x[AE + axis])
    if m >= VELOCITY:
        return float(x[VE + axis])
    total = x[FO + axis]
    for j in range(3):
        total += slope[axis, j] * x[TH + j] + slope[axis, 3 + j] * x[VE + j] + slope[axis, 6 + j] * x[AL + j]
    return float(total)


@_piece
def _accel_slope(c, row, air, x, slope):  # type: ignore[no-untyped-def]
    """Writes the derivative of the accelerometer by rotation vector, velocity and random alpha, (3, 9)."""
    slope[:] = 0.0
    slope[0, 8], slope[1, 8], slope[2, 6], slope[2, 7] = c[18], -c[17], -c[18], c[17]
    if air:
        r = _rotation(x[0], x[1], x[2], x[3])
        _, _, _, u, v, w = _force(c, 0.0, 0.0, x[0], x[1], x[2], x[3], x[VE + 1], x[VE + 2], x[VE + 3])
        s1 = row[2 * MOMENTS + 5]
        kx, ky, kz = c[12] * s1, c[13] * s1, c[25] * s1
        slope[0, 1], slope[0, 2], slope[1, 0], slope[1, 2] = kx * w, -kx * v, -ky * w, ky * u
        slope[2, 0], slope[2, 1] = kz * v, -kz * u
        for j in range(3):
            slope[0, 3 + j], slope[1, 3 + j], slope[2, 3 + j] = -kx * r[3 * j], -ky * r[3 * j + 1], -kz * r[3 * j + 2]


@_piece
def _is_measured(track: Track, k: int, channel: int) -> bool:
    """Presence of such a measurement; a velocity that nobody measures is about zero (see `Track.still`)."""
    return track.seen[k, channel // 3] or (channel >= VELOCITY and track.still > 0.0)


@_piece
def _white(track: Track, psi: FloatArray, row: FloatArray, k: int, channel: int, w: float) -> float:
    """Variance r / w of a scalar measurement, and that of the thrust which it is compared with."""
    if channel >= VELOCITY and not track.seen[k, 3]:
        h = track.t[k] - track.t[k - 1] if k > 0 else STILL_TIME
        return float(track.still * track.still * 2.0 * STILL_TIME / h)
    own = psi[channel] * psi[channel] / w
    return float(own + psi[ROTOR] ** 2 * _felt(track, row) if channel == ACCEL + 2 else own)


@_piece
def _felt(track: Track, row: FloatArray) -> float:
    """Variance of the mean specific thrust while the accelerometer reads, by readings of noise 1 rad/s.

    A sample acts for `period`, which may begin at any time within that of a reading.
    """
    if not track.read:
        return 0.0
    share = 2.0 * track.half / track.period
    kept = 1.0 - share / 3.0 if share < 1.0 else (1.0 - 1.0 / (3.0 * share)) / share
    return float(4.0 * row[2 * MOMENTS] * kept * track.waver[0])


def kalman(track: Track, p: FloatArray, psi: FloatArray, table: FloatArray | None = None) -> tuple[float, Gains]:
    """Filter pass over a flight.

    Args:
        track: the flight.
        p: physics, shape (N_PHYSICS,).
        psi: noise, shape (N_NOISE,).
        table: rotor moments at these physics where they are known; see `moments`.

    Returns:
        -2 ln L without the price of weights, and the gains.
    """
    rows = len(track.t)
    # Made here: numba crashes where Ctrl-C arrives while it makes a tuple of ours for what it returns.
    g = Gains(
        np.zeros((rows, M, N)),
        np.zeros((rows, M)),
        np.zeros((rows, M)),
        track.weight if len(track.weight) else np.ones((rows, M)),
        np.zeros((rows, 3, 9)),
        np.zeros((rows, N_MEAN)),
        np.zeros((rows, N, 9)),
        moments(track, *turning(p)) if table is None else table,
        turning(p),
        track.beyond,
    )
    return filter_pass(track, p, psi, g), g


@_piece
def _take(H: FloatArray, m: int, slope: FloatArray, r: float, P: FloatArray, PH: FloatArray, K: FloatArray) -> float:
    """Covariance and gain of Eq. 6 for scalar measurement m of variance r; returns S."""
    lane_kernel()
    for j in range(N):
        total = 0.0
        for i in range(N):
            total += H[m, i] * P[i, j]
        PH[j] = total
    S = r + _seen(m, slope, PH)
    root = math.sqrt(1.0 / S)
    for j in range(N):
        K[j] = PH[j] / S
        PH[j] *= root
    for i in range(0, N, 3):  # three rows a loop, or the compiler writes it out without vectors
        for j in range(N):
            for row in range(i, i + 3):
                P[row, j] -= PH[row] * PH[j]
    return float(S)


@_piece
def _update(track, psi, k, H, slope, nu, P, PH, K, dx, g):  # type: ignore[no-untyped-def]
    """Eq. 6 for all that is measured in row k, one scalar after the other; returns -2 ln of their density."""
    total = 0.0
    for i in range(N):
        dx[i] = 0.0
    for m in range(M):
        if not _is_measured(track, k, m):
            continue
        v = nu[m] - _seen(m, slope, dx)
        S = _take(H, m, slope, _white(track, psi, g.table[k], k, m, g.w[k, m]), P, PH, K)
        total += v * v / S + math.log(S)
        g.nu[k, m], g.S[k, m] = v, S
        for i in range(N):
            dx[i] += v * K[i]
            g.gain[k, m, i] = K[i]
    return total


@_fast
def filter_pass(track: Track, p: FloatArray, psi: FloatArray, g: Gains) -> float:
    """Writes the gains of `kalman` for their weights; returns -2 ln L."""
    n = len(track.t)
    air = _in_air(track)
    c, keep = _constants(p, track), np.empty(9)
    x, after = _start(track, p), np.empty(N_MEAN)
    P, FP, PF, F, H = np.zeros((N, N)), np.empty((FO, N)), np.empty((N, FO)), np.zeros((N, N)), np.empty((M, N))
    dx, PH, K, nu, turn = np.empty(N), np.empty(N), np.empty(N), np.zeros(M), np.zeros((3, 3))
    where, what, loose, step = np.zeros(4, dtype=np.int64), np.zeros(4), np.empty(4), np.zeros(12)
    _sensors(H)
    for i in range(3):
        P[TH + i, TH + i], P[OM + i, OM + i] = 0.09, 1.0
        P[VE + i, VE + i] = max(track.still, 1.0) ** 2 if air else 0.0
    for i in range(9):
        P[FO + i, FO + i] = psi[SIGMA + _GROUP[i]] ** 2
    total, before = 0.0, -1.0
    for k in range(n):
        slope = g.slope[k]
        # Update by all that was measured now, Eq. 6.
        _accel_slope(c, g.table[k], air, x, slope)
        _sense_beyond(track.beyond, k - 1, slope)
        _expected(c, p, track.y[k], track.seen[k], g.table[k], air, x, nu)
        _read_beyond(track.beyond, k, step, nu)
        _sense(slope, H)
        total += _update(track, psi, k, H, slope, nu, P, PH, K, dx, g)
        _correct(dx, x)
        _copy(x, g.mean[k])
        for i in range(N):
            for j in range(9):
                g.P[k, i, j] = P[i, FO + j]
        if k + 1 == n:
            break
        # Predict up to the next measurement, Eqs. 2 to 5.
        h = track.t[k + 1] - track.t[k]
        if abs(h - before) > 1e-12:
            _keep(psi, h, keep)
            before = h
        _copy(x, after)
        _advance(c, g.table[k], h, keep, air, after)
        _transition(c, g.table[k], h, keep, air, x, after, F, turn)
        _bend(track.beyond, k, F)
        _step_beyond(track.beyond, k, x, step)
        _copy(after, x)
        _go_beyond(track.beyond, step, dx, x)
        _spread(F, P, FP, PF)
        for i in range(9):
            count = _kick(h, air, i, turn, where, what)
            _widen(psi[SIGMA + _GROUP[i]] ** 2 * (1.0 - keep[i] ** 2), count, where, what, P)
        _wavering(track, g.table[k], h, loose)
        for i in range(4):
            _widen(psi[ROTOR] ** 2 * loose[i], _push(h, air, i, turn, where, what), where, what, P)
    return total


@_piece
def _spread(F: FloatArray, P: FloatArray, FP: FloatArray, PF: FloatArray) -> None:
    """P <- F P F' of a symmetric P and F of `_transition`; FP (FO, N) and PF (N, FO) are room."""
    lane_kernel()
    for i in range(FO):
        n = FO if i >= VE else AL  # velocity is moved by random forces, the others by random moments
        for j in range(N):
            total = 0.0
            for m in range(FO):
                total += F[i, m] * P[m, j]
            for m in range(n, n + 3):
                total += F[i, m] * P[m, j]
            FP[i, j] = total
    for i in range(FO):
        for j in range(N):
            PF[j, i] = FP[i, j]
    for i in range(FO):
        n = FO if i >= VE else AL
        for j in range(FO):
            total = 0.0
            for m in range(FO):
                total += F[i, m] * PF[m, j]
            for m in range(n, n + 3):
                total += F[i, m] * PF[m, j]
            P[i, j] = total
    for i in range(FO, N):
        for j in range(FO):
            P[i, j] = P[j, i] = F[i, i] * PF[i, j]
        for j in range(FO, N):
            P[i, j] *= F[i, i] * F[j, j]
    _even(P, FO)


@_piece
def _gather(F: FloatArray, L: FloatArray, LF: FloatArray) -> None:
    """L <- F' L F of a symmetric L; LF holds L F afterwards."""
    lane_kernel()
    for i in range(N):
        for j in range(N):
            total = 0.0
            for m in range(FO):
                total += L[i, m] * F[m, j]
            LF[i, j] = total
        for j in range(FO, N):
            LF[i, j] += L[i, j] * F[j, j]
    for i in range(N):
        for j in range(N):
            total = 0.0
            for m in range(FO):
                total += F[m, i] * LF[m, j]
            L[i, j] = total
    for i in range(FO, N):
        for j in range(N):
            L[i, j] += F[i, i] * LF[i, j]
    _even(L, N)


@_piece
def _even(P: FloatArray, size: int) -> None:
    """Makes the first rows and columns of a matrix symmetric: rounding that is not would grow."""
    for i in range(size):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@_fast
def replay(track: Track, p: FloatArray, psi: FloatArray, g: Gains, table: FloatArray, out: FloatArray) -> None:
    """Writes whitened innovations of other physics under the gains of a filter pass.

    Args:
        track: the flight.
        p: physics, shape (N_PHYSICS,).
        psi: noise of the pass.
        g: of the pass.
        table: moments of the rotors at these physics; see `moments`.
        out: shape (n, M); what was not measured is left as it is.
    """
    n = len(track.t)
    air = _in_air(track)
    c, keep, x = _constants(p, track), np.empty(9), _start(track, p)
    dx, nu, step, before = np.empty(N), np.zeros(M), np.zeros(12), -1.0
    for k in range(n):
        _expected(c, p, track.y[k], track.seen[k], table[k], air, x, nu)
        _read_beyond(track.beyond, k, step, nu)
        dx[:] = 0.0
        for m in range(M):
            if g.S[k, m] == 0.0:
                continue
            v = nu[m] - _seen(m, g.slope[k], dx)
            for i in range(N):
                dx[i] += g.gain[k, m, i] * v
            out[k, m] = v / math.sqrt(g.S[k, m])
        _correct(dx, x)
        if k + 1 < n:
            h = track.t[k + 1] - track.t[k]
            if abs(h - before) > 1e-12:
                _keep(psi, h, keep)
                before = h
            _step_beyond(track.beyond, k, x, step)
            _advance(c, table[k], h, keep, air, x)
            _go_beyond(track.beyond, step, dx, x)


@_piece
def _quadratic(count, where, what, l, L):  # type: ignore[no-untyped-def]
    """G' l and G' L G of a column with few entries."""
    along, spread = 0.0, 0.0
    for a in range(count):
        along += what[a] * l[where[a]]
        for b in range(count):
            spread += what[a] * L[where[a], where[b]] * what[b]
    return along, spread


@_piece
def _put_back(H: FloatArray, m: int, K: FloatArray, S: float, L: FloatArray, LK: FloatArray) -> float:
    """N of Eq. 7 for scalar measurement m, its gain and variance; returns D.  LK is room."""
    lane_kernel()
    for j in range(N):
        total = 0.0
        for i in range(N):
            total += L[i, j] * K[i]
        LK[j] = total
    D = 1.0 / S
    for i in range(N):
        D += K[i] * LK[i]
    for i in range(N):
        LK[i] -= 0.5 * D * H[m, i]
    for i in range(0, N, 3):
        for j in range(N):
            for row in range(i, i + 3):
                L[row, j] -= H[m, row] * LK[j] + LK[row] * H[m, j]
    return D


@_fast
def backward(
    track: Track, p: FloatArray, psi: FloatArray, g: Gains, smooth: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Smoother and score, Eqs. 7 to 9.

    Args:
        track: the flight.
        p: physics of the pass.
        psi: its noise.
        g: of the pass.
        smooth: whether the smoothed states are wanted; else they are zero.

    Returns:
        Derivative of -2 ln L by the noise numbers, shape (N_NOISE,); smoothed f, alpha, e, shape (n, 9), and their
        variances, shape (n, 9); sum of G' N G Q over each rotor noise of `_wavering`, and of D r over that which the
        accelerometer is compared with, shape (4,); mean square of the error of every scalar measurement over its
        variance r, given all of them, shape (n, M).
    """
    n = len(track.t)
    air = _in_air(track)
    score, mean, variance = np.zeros(N_NOISE), np.zeros((n, 9)), np.zeros((n, 9))
    l, fl, L, LF = np.zeros(N), np.zeros(N), np.zeros((N, N)), np.zeros((N, N))
    LK, turn, F, H = np.empty(N), np.zeros((3, 3)), np.zeros((N, N)), np.empty((M, N))
    c, after, before = _constants(p, track), np.empty(N_MEAN), -1.0
    where, what, keep = np.zeros(4, dtype=np.int64), np.zeros(4), np.empty(9)
    _sensors(H)
    loose, borrowed, own = np.empty(4), np.zeros(4), np.ones((n, M))
    for k in range(n - 1, -1, -1):
        if k + 1 < n:
            h = track.t[k + 1] - track.t[k]
            if abs(h - before) > 1e-12:
                _keep(psi, h, keep)
                before = h
            _copy(g.mean[k], after)
            _advance(c, g.table[k], h, keep, air, after)
            _transition(c, g.table[k], h, keep, air, g.mean[k], after, F, turn)
            _bend(g.beyond, k, F)
            _wavering(track, g.table[k], h, loose)
            for i in range(4):
                count = _push(h, air, i, turn, where, what)
                along, spread = _quadratic(count, where, what, l, L)
                score[ROTOR] -= (along * along - spread) * 2.0 * psi[ROTOR] * loose[i]
                borrowed[i] += spread * psi[ROTOR] ** 2 * loose[i]
            for i in range(9):
                # d / d sigma^2 through Q, d / d T through Q and F, Eq. 9.
                count = _kick(h, air, i, turn, where, what)
                along, spread = _quadratic(count, where, what, l, L)
                by_q = along * along - spread
                s, T = psi[SIGMA + _GROUP[i]], psi[TIME + _CLOCK[i]]
                score[SIGMA + _GROUP[i]] -= by_q * 2.0 * s * (1.0 - keep[i] ** 2)
                fade = keep[i] * h / (T * T)
                score[TIME + _CLOCK[i]] -= by_q * s * s * (-2.0 * keep[i] * fade)
            # F' l, F' N F; then what the smoother adds to the mean after the updates, Eq. 8.
            for i in range(N):
                fl[i] = 0.0
            for m in range(N):
                for i in range(N):
                    fl[i] += F[m, i] * l[m]
            _gather(F, L, LF)
            # d / d F for the decay of each Gauss-Markov state and its mean over the step.
            for i in range(9):
                s, T = psi[SIGMA + _GROUP[i]], psi[TIME + _CLOCK[i]]
                count = _kick(h, air, i, turn, where, what)
                # F's column is (what acts in the step) (1 + keep) / 2, and keep itself
                if 3 <= i < 6:
                    what[2] *= 1.5
                state = g.mean[k, FO + 1 + i]
                for j in range(N):
                    state += g.P[k, j, i] * fl[j]
                by_keep = 0.0
                for a in range(count):
                    inner = 0.0
                    for j in range(N):
                        inner += LF[where[a], j] * g.P[k, j, i]
                    by_keep += what[a] * (l[where[a]] * state - inner)
                score[TIME + _CLOCK[i]] -= 2.0 * by_keep * keep[i] * h / (T * T)
            for i in range(N):
                l[i] = fl[i]
        for i in range(9 if smooth else 0):
            mean[k, i], variance[k, i] = g.mean[k, FO + 1 + i], g.P[k, FO + i, i]
            for j in range(N):
                mean[k, i] += g.P[k, j, i] * l[j]
                for m in range(N):
                    variance[k, i] -= g.P[k, j, i] * L[j, m] * g.P[k, m, i]
        _sense(g.slope[k], H)
        for m in range(M - 1, -1, -1):
            if g.S[k, m] == 0.0:
                continue
            K, u = g.gain[k, m], g.nu[k, m] / g.S[k, m]
            for i in range(N):
                u -= K[i] * l[i]
            for i in range(N):
                l[i] += H[m, i] * u
            D = _put_back(H, m, K, g.S[k, m], L, LK)
            if m < VELOCITY or track.seen[k, 3]:
                noise = psi[m] * psi[m] / g.w[k, m]
                own[k, m] = (1.0 + noise * (u * u - D)) / g.w[k, m]
                score[m] -= (u * u - D) / g.w[k, m] * 2.0 * psi[m]
            if m == ACCEL + 2:
                felt = _felt(track, g.table[k])
                score[ROTOR] -= (u * u - D) * 2.0 * psi[ROTOR] * felt
                borrowed[0] += D * psi[ROTOR] ** 2 * felt
    # The first covariance of the Gauss-Markov states is sigma^2.
    for i in range(9):
        s = psi[SIGMA + _GROUP[i]]
        score[SIGMA + _GROUP[i]] -= (l[FO + i] ** 2 - L[FO + i, FO + i]) * 2.0 * s
    return score, mean, variance, borrowed, own
