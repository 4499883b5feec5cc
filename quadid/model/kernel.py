"""What many parameter vectors ("lanes") need of the model, and their constants of the body."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from quadid.model import layout as ix
from quadid.model.layout import places
from quadid.model.simd import LANES, SOURCES, cached, exact, inlined, jit, lane_kernel
from quadid.types import FloatArray, IntArray
from quadid.vehicle import GRAVITY

# isort: off
from quadid.model.work_array import (
    A_G, A_M, C_B, C_CGX, C_CGY, C_CLIMB, C_CPAR, C_CPAR_Z, C_D, C_DRAG_ARM, C_DROP, C_DROP_TIME, C_FLOW_ARM, C_GROUND,
    C_GX, C_GXX, C_GXY, C_GY, C_GYY, C_HOVER, C_HUB, C_HX, C_HY, C_INVM, C_IXX, C_IXY, C_IXZ, C_IYY, C_IYZ, C_IZZ, C_JR,
    C_JSPIN, C_JXX, C_JXY, C_JXZ, C_JYY, C_JYZ, C_JZZ, C_KX, C_KY, C_KZ, C_LIFT, C_LOAD, C_LOAD_TIME, C_LOWEST, C_LP,
    C_MQ, C_NR, C_RX, C_RY, C_RZ, C_SAG, C_TURNING, C_WE, C_WN, HALF,
)  # fmt: skip
# isort: on

# --- Which parts of the model a block of parameter vectors uses, so that the others cost nothing


class Needs(NamedTuple):
    """Which parts of the model any lane of a block uses.

    Attributes:
        air, hub, solid, rare: these groups of `quadid.model.body_kernel`.
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
    "rotor_drag_moment", "rate_damping", "cg_offset", "product_of_inertia", "rotor_spin_up", "imu_lever_arm",
    "no_gyroscopic_coupling", "rotor_drag.central", "axial_inflow.central",
)  # fmt: skip
IMU_ENTRIES = places("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment")
DELAY_ENTRIES = places("command_delay", "rotor_telemetry_delay")
ROTOR_ENTRIES = places(
    "motor_lag", "command_delay", "rotor_telemetry_delay", "thrust_curve", "supply_voltage", "drag_torque_curve"
)
"""What makes rotors of one lane differ from those of another; losses beside them."""
# As arrays, which all are of one type: `_any_of` would be compiled anew for each length of a tuple.
_HUB, _RARE, _PAYLOAD, _FACTORS = (np.array(e) for e in (HUB_ENTRIES, RARE_ENTRIES, PAYLOAD_ENTRIES, FACTOR_ENTRIES))
_SOLID, _IMU, _DELAY = (np.array(e) for e in (SOLID_ENTRIES, IMU_ENTRIES, DELAY_ENTRIES))
_SLOWER, _EXPONENT = np.array(places("motor_lag.slower")), np.array(places("supply_voltage"))
_GROWTH, _AHRS = np.array(places("drag_torque_curve")), np.array([ix.AHRS_K])
_IMU_LAG, _ATT_DELAY = np.array([ix.IMU_PERIOD]), np.array([ix.ATT_DELAY])


@nb.njit(**jit)
def _any_of(theta: FloatArray, entries: IntArray) -> bool:
    """Whether any of these entries is not neutral in any lane."""
    found = False
    for lane in range(len(theta)):
        for i in entries:
            found |= theta[lane, i] != 0.0
    return found


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def needs_of(theta: FloatArray, rotors: int, channels: int) -> Needs:
        """Returns what a block of parameter vectors (LANES, size) needs of the model."""
        _ = sources
        rare, factors, payload = (
            _any_of(theta, _RARE), _any_of(theta, _FACTORS), _any_of(theta, _PAYLOAD)
        )  # fmt: skip
        learned = False
        for lane in range(len(theta)):
            for i in range(ix.LOSS + 2 * rotors, theta.shape[1]):
                learned |= theta[lane, i] != 0.0
        rare |= learned
        hub = rare or _any_of(theta, _HUB)
        air, solid = channels > 9 or hub, factors or learned or _any_of(theta, _SOLID)
        growth = _any_of(theta, _GROWTH)
        varied = growth
        for lane in range(len(theta)):
            for i in ROTOR_ENTRIES:
                varied |= theta[lane, i] != theta[0, i]
            for i in range(ix.LOSS, ix.LOSS + 2 * rotors):
                varied |= theta[lane, i] != theta[0, i]
            varied |= theta[lane, ix.OFFSET] != 0.0 and theta[lane, ix.B] != theta[0, ix.B]
        return Needs(
            air, hub, solid, rare, not varied, _any_of(theta, _DELAY), _any_of(theta, _SLOWER),
            _any_of(theta, _EXPONENT), growth, factors, payload, _any_of(theta, _IMU_LAG),
            _any_of(theta, _ATT_DELAY), _any_of(theta, _IMU), _any_of(theta, _AHRS), learned,
        )  # fmt: skip

    return needs_of


needs_of = _on_disk(SOURCES)


# --- Constants of the body, and what changes them in flight


SLOWEST_HOVER = 0.1
"""Least speed in hover, as a share of what a thrust without dead speed gives: a curve that is nearly straight has none
of its own."""
(LIFT,), (BESIDE_Z,) = places("translational_lift"), places("parasitic_drag.beside_z")
(UNCOUPLED,) = places("no_gyroscopic_coupling")
LOAD_XX, LOAD_YY, LOAD_ZZ, LOAD_X, LOAD_Y = places(*(f"mass_change.{k}" for k in ("J_xx", "J_yy", "J_zz", "x", "y")))


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
        flight: numbers of the window.
        rotors: number of rotors.
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
            th[ix.JXX] * (1.0 + part * th[LOAD_XX]), th[ix.JYY] * (1.0 + part * th[LOAD_YY]),
            th[ix.JZZ] * (1.0 + part * th[LOAD_ZZ]), -th[ix.JXY], -th[ix.JXZ], -th[ix.JYZ], lane, s,
        )  # fmt: skip
        x, y = th[ix.CGX] + part * th[LOAD_X], th[ix.CGY] + part * th[LOAD_Y]
        s[C_CGX + lane], s[C_CGY + lane], s[C_RX + lane], s[C_RY + lane] = x, y, th[ix.LAX] - x, th[ix.LAY] - y
