"""Which parts of the model a block of parameter vectors uses, so that the others cost nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from quadid.model import layout as ix
from quadid.model.layout import places
from quadid.model.simd import SOURCES, cached, jit
from quadid.types import FloatArray, IntArray


class Needs(NamedTuple):
    """Which parts of the model any lane of a block uses.

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
    "rotor_drag_moment", "rate_damping", "cg_offset", "product_of_inertia", "rotor_spin_up", "imu_lever_arm",
    "no_gyroscopic_coupling", "rotor_drag.central", "axial_inflow.central",
)  # fmt: skip
IMU_ENTRIES = places("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment")
DELAY_ENTRIES = places("command_delay", "rotor_telemetry_delay")
ROTOR_ENTRIES = places(
    "motor_lag", "command_delay", "rotor_telemetry_delay", "thrust_curve", "supply_voltage", "drag_torque_curve"
)
"""What makes rotors of one lane differ from those of another; losses beside them."""
(OFFSET,) = places("thrust_curve.offset")
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
            varied |= theta[lane, OFFSET] != 0.0 and theta[lane, ix.B] != theta[0, ix.B]
        return Needs(
            air or solid, air, hub, solid, rare, not varied, _any_of(theta, _DELAY), _any_of(theta, _SLOWER),
            _any_of(theta, _EXPONENT), growth, factors, payload, _any_of(theta, _IMU_LAG),
            _any_of(theta, _ATT_DELAY), _any_of(theta, _IMU), _any_of(theta, _AHRS), learned,
        )  # fmt: skip

    return needs_of


needs_of = _on_disk(SOURCES)
