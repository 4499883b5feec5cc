"""Which parts of the model a block of parameter vectors uses, so that the others cost nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model import layout as ix
from quadid.model.layout import places
from quadid.model.simd import SOURCES, cached, jit

FloatArray = NDArray[np.float64]


class Needs(NamedTuple):
    """Which parts of the model any lane of a block uses.

    Attributes:
        full: more than the nominal step: one of the groups of `quadid.model.body_kernel`.
        air, solid, rare: these groups.
        shared: lag, delay, dead speed and losses are the same in all lanes, and their moments are tabled.
        delayed: commands are delayed.
        factors: thrust or mass change in flight.
        imu_lag, att_delay, imu_static, ahrs: these sensor effects act.
    """

    full: bool
    air: bool
    solid: bool
    rare: bool
    shared: bool
    delayed: bool
    factors: bool
    imu_lag: bool
    att_delay: bool
    imu_static: bool
    ahrs: bool
    learned: bool


AIR_ENTRIES = places("rotor_drag", "axial_inflow")
RARE_ENTRIES = places("parasitic_drag", "ground_effect")
SOLID_ENTRIES = places(
    "rotor_drag_moment", "rate_damping", "cg_offset", "product_of_inertia", "rotor_spin_up", "imu_lever_arm"
)
FACTOR_ENTRIES = places("battery_sag", "thrust_drop.fraction", "mass_change.fraction")
IMU_ENTRIES = places("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment")
ROTOR_ENTRIES = places("motor_lag", "command_delay", "thrust_curve")


@nb.njit(**jit)
def _needs_of(theta: FloatArray, rotors: int, channels: int) -> Needs:
    """Returns what a block of parameter vectors (LANES, size) needs of the model."""
    air, solid, rare, factors, varied, imu_static = channels > 9, False, False, False, False, False
    delayed, imu_lag, att_delay, ahrs, learned = False, False, False, False, False
    for lane in range(len(theta)):
        for i in AIR_ENTRIES:
            air |= theta[lane, i] != 0.0
        for i in RARE_ENTRIES:
            rare |= theta[lane, i] != 0.0
        for i in SOLID_ENTRIES:
            solid |= theta[lane, i] != 0.0
        for i in FACTOR_ENTRIES:
            factors |= theta[lane, i] != 0.0
        for i in ROTOR_ENTRIES:
            varied |= theta[lane, i] != theta[0, i]
        for i in range(ix.LOSS, ix.LOSS + rotors):
            varied |= theta[lane, i] != theta[0, i]
        for i in range(ix.LOSS + rotors, theta.shape[1]):
            learned |= theta[lane, i] != 0.0
        for i in IMU_ENTRIES:
            imu_static |= theta[lane, i] != 0.0
        delayed |= theta[lane, ix.DELAY] > 0.0
        imu_lag |= theta[lane, ix.IMU_PERIOD] > 0.0
        att_delay |= theta[lane, ix.ATT_DELAY] > 0.0
        ahrs |= theta[lane, ix.AHRS_K] != 0.0
    rare, solid = rare or learned, solid or factors or learned
    air = air or rare
    return Needs(
        air or solid, air, solid, rare, not varied, delayed, factors, imu_lag, att_delay, imu_static, ahrs, learned
    )


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def needs_of(*arguments):  # type: ignore[no-untyped-def]
        _ = sources
        return _needs_of(*arguments)

    return needs_of


needs_of = _on_disk(SOURCES)
