"""Hot kernel: one step for many parameter vectors ("lanes") at once, without the parts that none of them needs."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from quadid.model import layout as ix
from quadid.model.layout import places
from quadid.model.simd import LANES, exact, inlined, jit, lane_kernel
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

# isort: off
from quadid.model.simd import (
    ALL_MOMENTS, A_G, A_M, A_O1, A_S2, A_X2, A_Y2, A_Z2, C_B, C_CGX, C_CGY, C_CLIMB, C_CPAR, C_CPAR_Z, C_D, C_DRAG_ARM,
    C_DROP, C_DROP_TIME, C_FLOW_ARM, C_GROUND, C_GX, C_GXX, C_GXY, C_GY, C_GYY, C_HOVER, C_HUB, C_HX, C_HY, C_INVM,
    C_IXX, C_IXY, C_IXZ, C_IYY, C_IYZ, C_IZZ, C_JR, C_JSPIN, C_JXX, C_JXY, C_JXZ, C_JYY, C_JYZ, C_JZZ, C_KX, C_KY, C_KZ,
    C_LIFT, C_LOAD, C_LOAD_TIME, C_LOWEST, C_LP, C_MQ, C_NR, C_RX, C_RY, C_RZ, C_SAG, C_TURNING, C_WE, C_WN,
    F0_X, F0_Y, F0_Z, F1_X, F1_Y, F1_Z, F2_X, F2_Y, F2_Z, HALF, S_BENDX, S_BENDY, S_BENDZ, S_FX, S_FY, S_FZ,
    S_P, S_Q, S_QW, S_QX, S_QY, S_QZ, S_R, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ, X_R,
)  # fmt: skip
# isort: on

# --- Which parts of the model a block of parameter vectors uses, so that the others cost nothing


class Needs(NamedTuple):
    """Parts of the model that any lane of a block uses.

    Attributes:
        full: more than the nominal step: one of the groups of `quadid.model.body_kernel`.
        air, hub, solid, rare: these groups.
        shared: all that acts on rotors is the same in all lanes, and their moments are tabled.
        delayed: commands, or readings of speed, come late.
        uneven: speeding up and slowing down lag differently.
        voltage: the supply voltage scales commands.
        growth: drag torque is not quadratic.
        factors: thrust or mass change in flight.
        payload: inertia or centre of gravity change with mass.
        imu_lag, att_delay, imu_static, ahrs: these sensor effects act.
        learned: terms beyond the catalogue act.
    """

    full: bool
    air: bool
    hub: bool
    solid: bool
    rare: bool
    shared: bool
    delayed: bool
    uneven: bool
    voltage: bool
    growth: bool
    factors: bool
    payload: bool
    imu_lag: bool
    att_delay: bool
    imu_static: bool
    ahrs: bool
    learned: bool


HUB_ENTRIES = places("rotor_drag.k_x", "rotor_drag.k_y", "axial_inflow.k_z")
RARE_ENTRIES = places("parasitic_drag", "ground_effect", "translational_lift", "axial_inflow.k_climb")
PAYLOAD_ENTRIES = places(*(f"mass_change.{key}" for key in ("J_xx", "J_yy", "J_zz", "x", "y")))
FACTOR_ENTRIES = (*places("battery_sag", "thrust_drop.fraction", "mass_change.fraction"), *PAYLOAD_ENTRIES)
SOLID_ENTRIES = places(
    "rotor_drag_moment",
    "rate_damping",
    "cg_offset",
    "product_of_inertia",
    "rotor_spin_up",
    "imu_lever_arm",
    "no_gyroscopic_coupling",
    "rotor_drag.central",
    "axial_inflow.central",
)
IMU_ENTRIES = places("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment")
DELAY_ENTRIES = places("command_delay", "rotor_telemetry_delay")
ROTOR_ENTRIES = places(
    "motor_lag", "command_delay", "rotor_telemetry_delay", "thrust_curve", "supply_voltage", "drag_torque_curve"
)
"""Differences between the rotors of one lane and those of another; losses beside them."""
_SLOWER, _EXPONENT, _GROWTH = places("motor_lag.slower"), places("supply_voltage"), places("drag_torque_curve")


def needs_of(theta: FloatArray, rotors: int, channels: int) -> Needs:
    """Returns what a block of parameter vectors (LANES, size) needs of the model."""
    last = ix.LOSS + 2 * rotors
    # Entries that are not neutral in any lane, and those in which the lanes differ.
    used = set(np.flatnonzero((theta != 0.0).any(axis=0)).tolist())
    split = set(np.flatnonzero((theta != theta[0]).any(axis=0)).tolist())

    def acts(*entries: int) -> bool:
        return not used.isdisjoint(entries)

    learned = acts(*range(last, theta.shape[1]))
    factors, growth = acts(*FACTOR_ENTRIES), acts(*_GROWTH)
    rare = learned or acts(*RARE_ENTRIES)
    hub = rare or acts(*HUB_ENTRIES)
    air, solid = channels > 9 or hub, factors or learned or acts(*SOLID_ENTRIES)
    varied = growth or not split.isdisjoint((*ROTOR_ENTRIES, *range(ix.LOSS, last)))
    varied = varied or (acts(ix.OFFSET) and ix.B in split)
    return Needs(
        air or solid, air, hub, solid, rare, not varied, acts(*DELAY_ENTRIES), acts(*_SLOWER), acts(*_EXPONENT),
        growth, factors, acts(*PAYLOAD_ENTRIES), acts(ix.IMU_PERIOD), acts(ix.ATT_DELAY), acts(*IMU_ENTRIES),
        acts(ix.AHRS_K), learned,
    )  # fmt: skip


# --- The hot kernel: one step of the rigid body for many parameter vectors ("lanes") at once
#
# Lanes are the innermost, fixed-length axis, so that the compiler turns each lane loop into SIMD instructions: no
# trigonometry in the loops, no allocation, no branch that depends on a lane.  Where each row lies: `model.simd`.
#
# Integration: forces and moments are taken linear in time over the step with the rotors' half-step means
# (`quadid.model.rotor_kernel`), and attitude, rate and velocity are integrated with the classical Runge-Kutta rule.
# Here is the nominal step; effects on the body are in `quadid.model.body_kernel`.  Both are the same equations, listed
# in `quadid.model.equations`.


SLOWEST_HOVER = 0.1
"""Least speed in hover, as a share of what a thrust without dead speed gives: a curve that is nearly straight has none
of its own."""
(LIFT,), (BESIDE_Z,) = places("translational_lift"), places("parasitic_drag.beside_z")
(UNCOUPLED,) = places("no_gyroscopic_coupling")
LOAD_XX, LOAD_YY, LOAD_ZZ, LOAD_X, LOAD_Y = places(*(f"mass_change.{k}" for k in ("J_xx", "J_yy", "J_zz", "x", "y")))
TWELFTH = 1.0 / 12.0


class Flight(NamedTuple):
    """Numbers of one window.

    Attributes:
        mass: of the vehicle [kg].
        reach: half the smallest distance between rotors [m], scales ground effect.
        hub: mean z of the hubs [m].
        plan: means of x, y, x^2, y^2, xy of the hubs.
        t0, dt: of the grid [s].
        span0, span1: first and last time of the log [s].
    """

    mass: float
    reach: float
    hub: float
    plan: tuple[float, float, float, float, float]
    t0: float
    dt: float
    span0: float
    span1: float


@nb.njit(**inlined)
def _inertia(jxx, jyy, jzz, jxy, jxz, jyz, lane, s):  # type: ignore[no-untyped-def]
    """Writes an inertia tensor and its inverse."""
    det = jxx * (jyy * jzz - jyz * jyz) - jxy * (jxy * jzz - jyz * jxz) + jxz * (jxy * jyz - jyy * jxz)
    s[C_IXX + lane] = (jyy * jzz - jyz * jyz) / det
    s[C_IYY + lane] = (jxx * jzz - jxz * jxz) / det
    s[C_IZZ + lane] = (jxx * jyy - jxy * jxy) / det
    s[C_IXY + lane] = (jxz * jyz - jxy * jzz) / det
    s[C_IXZ + lane] = (jxy * jyz - jxz * jyy) / det
    s[C_IYZ + lane] = (jxy * jxz - jxx * jyz) / det
    s[C_JXX + lane], s[C_JYY + lane], s[C_JZZ + lane] = jxx, jyy, jzz
    s[C_JXY + lane], s[C_JXZ + lane], s[C_JYZ + lane] = jxy, jxz, jyz


@nb.njit(**inlined)
def _hover_speed(th, weight):  # type: ignore[no-untyped-def]
    """Speed at which a rotor carries its share of the weight [N]: b (omega - dead_speed)^2 + offset."""
    b = abs(th[ix.B])
    least = SLOWEST_HOVER * math.sqrt(weight / b)
    return max(math.sqrt(max(weight - th[ix.OFFSET], 0.0) / b) + th[ix.DEAD_SPEED], least)


@nb.njit(**exact)
def body_constants(theta: FloatArray, flight: Flight, rotors: int, s: FloatArray) -> None:
    """Derives the body's constants of all lanes from their parameter vectors.

    Args:
        theta: shape (LANES, size), see `quadid.model.layout`.
        s: rows, written.
    """
    for lane in range(LANES):
        th = theta[lane]
        _inertia(th[ix.JXX], th[ix.JYY], th[ix.JZZ], -th[ix.JXY], -th[ix.JXZ], -th[ix.JYZ], lane, s)
        s[C_B + lane], s[C_D + lane], s[C_JR + lane], s[C_JSPIN + lane] = th[ix.B], th[ix.D], th[ix.JR], th[ix.JSPIN]
        s[C_INVM + lane] = 1.0 / flight.mass
        hover = 1.0 / (rotors * _hover_speed(th, flight.mass * GRAVITY / rotors))
        s[C_HOVER + lane], s[C_HUB + lane] = hover, flight.hub
        each = flight.mass * hover
        s[C_KX + lane], s[C_KY + lane], s[C_KZ + lane] = each * th[ix.KX], each * th[ix.KY], each * th[ix.KZ]
        s[C_DRAG_ARM + lane], s[C_FLOW_ARM + lane] = 1.0 - th[ix.DRAG_CENTRAL], 1.0 - th[ix.FLOW_CENTRAL]
        s[C_CPAR + lane], s[C_CPAR_Z + lane] = th[ix.CPAR], th[ix.CPAR] + th[BESIDE_Z]
        s[C_HX + lane], s[C_HY + lane] = th[ix.HX], th[ix.HY]
        s[C_LIFT + lane], s[C_CLIMB + lane] = flight.mass * th[LIFT], flight.mass * th[ix.KCLIMB]
        s[C_GX + lane], s[C_GY + lane], s[C_GXX + lane] = flight.plan[0], flight.plan[1], flight.plan[2]
        s[C_GYY + lane], s[C_GXY + lane] = flight.plan[3], flight.plan[4]
        s[C_LP + lane], s[C_MQ + lane], s[C_NR + lane] = th[ix.LP], th[ix.MQ], th[ix.NR]
        s[C_TURNING + lane] = 1.0 - th[UNCOUPLED]
        s[C_WN + lane], s[C_WE + lane] = th[ix.WN], th[ix.WE]
        s[C_CGX + lane], s[C_CGY + lane] = th[ix.CGX], th[ix.CGY]
        s[C_RX + lane], s[C_RY + lane], s[C_RZ + lane] = th[ix.LAX] - th[ix.CGX], th[ix.LAY] - th[ix.CGY], th[ix.LAZ]
        ground = th[ix.GROUND] * flight.reach / 4.0
        s[C_GROUND + lane], s[C_LOWEST + lane], s[C_SAG + lane] = ground * abs(ground), 2.0 * abs(ground), th[ix.SAG]
        s[C_DROP_TIME + lane], s[C_DROP + lane] = th[ix.DROP_TIME], th[ix.DROP_FRACTION]
        s[C_LOAD_TIME + lane], s[C_LOAD + lane] = th[ix.MASS_TIME], th[ix.MASS_FRACTION] / (1.0 + th[ix.MASS_FRACTION])


@nb.njit(**jit)
def flight_factors(t: float, span0: float, span1: float, dt: float, s: FloatArray) -> None:
    """Writes factors of thrust and inverse mass, means over both half steps: battery sag, thrust drop, mass change."""
    lane_kernel()
    inv = 1.0 / max(span1 - span0, 1e-9)
    half = 0.5 * dt
    inv_half = 1.0 / half
    for h in range(2):
        ts = t + h * half
        mid = (ts + 0.5 * half - span0) * inv
        for lane in range(LANES):
            dropped = min(max((ts + half - s[C_DROP_TIME + lane]) * inv_half, 0.0), 1.0)
            loaded = min(max((ts + half - s[C_LOAD_TIME + lane]) * inv_half, 0.0), 1.0)
            s[A_G + h * HALF + lane] = (1.0 - s[C_SAG + lane] * mid) * (1.0 - s[C_DROP + lane] * dropped)
            s[A_M + h * HALF + lane] = 1.0 - loaded * s[C_LOAD + lane]


@nb.njit(**jit)
def copy(source: FloatArray, target: FloatArray) -> None:
    """Copies an array of two axes; loops, because an assignment of arrays compiles a check of their shapes."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@nb.njit(**exact)
def load_payload(t: float, dt: float, theta: FloatArray, s: FloatArray) -> None:
    """Writes inertia, centre of gravity and lever arm with the share of a payload that is there in the step from t."""
    for lane in range(LANES):
        th = theta[lane]
        part = min(max((t + dt - s[C_LOAD_TIME + lane]) / dt, 0.0), 1.0)
        _inertia(
            th[ix.JXX] * (1.0 + part * th[LOAD_XX]),
            th[ix.JYY] * (1.0 + part * th[LOAD_YY]),
            th[ix.JZZ] * (1.0 + part * th[LOAD_ZZ]),
            -th[ix.JXY],
            -th[ix.JXZ],
            -th[ix.JYZ],
            lane,
            s,
        )
        x, y = th[ix.CGX] + part * th[LOAD_X], th[ix.CGY] + part * th[LOAD_Y]
        s[C_CGX + lane], s[C_CGY + lane], s[C_RX + lane], s[C_RY + lane] = x, y, th[ix.LAX] - x, th[ix.LAY] - y


@nb.njit(**inlined)
def rotation_rate(qw, qx, qy, qz, p, q, r):  # type: ignore[no-untyped-def]
    """Eq. 1 as a quaternion: d/dt q = q (0, p, q, r) / 2."""
    return (
        0.5 * (-qx * p - qy * q - qz * r),
        0.5 * (qw * p + qy * r - qz * q),
        0.5 * (qw * q + qz * p - qx * r),
        0.5 * (qw * r + qx * q - qy * p),
    )


@nb.njit(**inlined)
def put_force(ax, ay, az, bx, by, bz, lane, s):  # type: ignore[no-untyped-def]
    """Stores the mean specific force of both half steps, and over one sample centred on the start of the step."""
    s[S_FX + lane] = 0.5 * (s[F0_X + lane] + ax)
    s[S_FY + lane] = 0.5 * (s[F0_Y + lane] + ay)
    s[S_FZ + lane] = 0.5 * (s[F0_Z + lane] + az)
    s[F1_X + lane], s[F1_Y + lane], s[F1_Z + lane] = ax, ay, az
    s[F2_X + lane], s[F2_Y + lane], s[F2_Z + lane] = bx, by, bz
    s[F0_X + lane], s[F0_Y + lane], s[F0_Z + lane] = bx, by, bz


@nb.njit(**inlined)
def _core(s2a, s2b, x2a, x2b, y2a, y2b, z2a, z2b, o1a, o1b, dt, lane, s):  # type: ignore[no-untyped-def]
    """`step_core` of one lane for these rotor moments, means over the first and the second half step."""
    b, d = s[C_B + lane], s[C_D + lane]
    ixx, iyy, izz = s[C_IXX + lane], s[C_IYY + lane], s[C_IZZ + lane]
    jxx, jyy, jzz, jr = s[C_JXX + lane], s[C_JYY + lane], s[C_JZZ + lane], s[C_JR + lane]
    tx1, tx2 = -b * y2a, -b * y2b
    ty1, ty2 = b * x2a, b * x2b
    tz1, tz2 = d * z2a, d * z2b
    o1, o2 = jr * o1a, jr * o1b
    lift = -b * s[C_INVM + lane]
    put_force(0.0, 0.0, lift * s2a, 0.0, 0.0, lift * s2b, lane, s)
    qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
    p, q, r = s[X_P + lane], s[X_Q + lane], s[X_R + lane]
    s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane] = qw, qx, qy, qz
    s[S_P + lane], s[S_Q + lane], s[S_R + lane] = p, q, r
    cx, cy, cz = (jyy - jzz) * ixx, (jzz - jxx) * iyy, (jxx - jyy) * izz
    # stage 1
    tx, ty, tz, o = 1.5 * tx1 - 0.5 * tx2, 1.5 * ty1 - 0.5 * ty2, 1.5 * tz1 - 0.5 * tz2, 1.5 * o1 - 0.5 * o2
    a1x, a1y, a1z = cx * q * r + (tx + o * q) * ixx, cy * p * r + (ty - o * p) * iyy, cz * p * q + tz * izz
    k1w, k1x, k1y, k1z = rotation_rate(qw, qx, qy, qz, p, q, r)
    # stage 2
    h = 0.5 * dt
    tx, ty, tz, o = 0.5 * (tx1 + tx2), 0.5 * (ty1 + ty2), 0.5 * (tz1 + tz2), 0.5 * (o1 + o2)
    p2, q2, r2 = p + h * a1x, q + h * a1y, r + h * a1z
    a2x, a2y, a2z = cx * q2 * r2 + (tx + o * q2) * ixx, cy * p2 * r2 + (ty - o * p2) * iyy, cz * p2 * q2 + tz * izz
    k2w, k2x, k2y, k2z = rotation_rate(qw + h * k1w, qx + h * k1x, qy + h * k1y, qz + h * k1z, p2, q2, r2)
    # stage 3
    p3, q3, r3 = p + h * a2x, q + h * a2y, r + h * a2z
    a3x, a3y, a3z = cx * q3 * r3 + (tx + o * q3) * ixx, cy * p3 * r3 + (ty - o * p3) * iyy, cz * p3 * q3 + tz * izz
    k3w, k3x, k3y, k3z = rotation_rate(qw + h * k2w, qx + h * k2x, qy + h * k2y, qz + h * k2z, p3, q3, r3)
    # stage 4
    tx, ty, tz, o = 1.5 * tx2 - 0.5 * tx1, 1.5 * ty2 - 0.5 * ty1, 1.5 * tz2 - 0.5 * tz1, 1.5 * o2 - 0.5 * o1
    p4, q4, r4 = p + dt * a3x, q + dt * a3y, r + dt * a3z
    a4x, a4y, a4z = cx * q4 * r4 + (tx + o * q4) * ixx, cy * p4 * r4 + (ty - o * p4) * iyy, cz * p4 * q4 + tz * izz
    k4w, k4x, k4y, k4z = rotation_rate(qw + dt * k3w, qx + dt * k3x, qy + dt * k3y, qz + dt * k3z, p4, q4, r4)
    sixth = dt / 6.0
    qw += sixth * (k1w + 2.0 * (k2w + k3w) + k4w)
    qx += sixth * (k1x + 2.0 * (k2x + k3x) + k4x)
    qy += sixth * (k1y + 2.0 * (k2y + k3y) + k4y)
    qz += sixth * (k1z + 2.0 * (k2z + k3z) + k4z)
    scale = 1.5 - 0.5 * (qw * qw + qx * qx + qy * qy + qz * qz)  # one Newton step to unit length
    s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane] = qw * scale, qx * scale, qy * scale, qz * scale
    s[X_P + lane] = p + sixth * (a1x + 2.0 * (a2x + a3x) + a4x)
    s[X_Q + lane] = q + sixth * (a1y + 2.0 * (a2y + a3y) + a4y)
    s[X_R + lane] = r + sixth * (a1z + 2.0 * (a2z + a3z) + a4z)
    s[S_BENDX + lane], s[S_BENDY + lane] = h * (a4x - a1x), h * (a4y - a1y)
    s[S_BENDZ + lane] = h * (a4z - a1z)


@nb.njit(**jit)
def step_core(dt: float, s: FloatArray) -> None:
    """One step of attitude and rate without velocity: Eqs. 1 and 9 with a diagonal inertia.

    Args:
        dt: step [s].
        s: rows; state advanced in place; what reaches the sensors at the start of the step and mean specific force
            [m/s^2] over both half steps written.
    """
    lane_kernel()
    for lane in range(LANES):
        _core(
            s[A_S2 + lane],
            s[A_S2 + HALF + lane],
            s[A_X2 + lane],
            s[A_X2 + HALF + lane],
            s[A_Y2 + lane],
            s[A_Y2 + HALF + lane],
            s[A_Z2 + lane],
            s[A_Z2 + HALF + lane],
            s[A_O1 + lane],
            s[A_O1 + HALF + lane],
            dt,
            lane,
            s,
        )


@nb.njit(**jit)
def step_core_shared(dt: float, table: FloatArray, k: int, s: FloatArray) -> None:
    """`step_core` where all lanes share the rotor moments of row k of `table`, see `rotor_kernel.rotor_table`."""
    lane_kernel()
    s2a, x2a, y2a, z2a, o1a = table[k, 0], table[k, 1], table[k, 2], table[k, 3], table[k, 4]
    s2b, x2b, y2b = table[k, ALL_MOMENTS], table[k, ALL_MOMENTS + 1], table[k, ALL_MOMENTS + 2]
    z2b, o1b = table[k, ALL_MOMENTS + 3], table[k, ALL_MOMENTS + 4]
    for lane in range(LANES):
        _core(s2a, s2b, x2a, x2b, y2a, y2b, z2a, z2b, o1a, o1b, dt, lane, s)
