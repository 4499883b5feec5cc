"""The effects a simulation may lack: names, parameters, units and neutral values.

This table is the vocabulary shared by the vehicle file, the model, the diagnosis and the flown truth.  It holds no
equations: those of the model under test are in `quadid.model`, those of the flown vehicle in `quadid.flight`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from quadid.errors import ParameterError


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        name: name inside the effect, as written in vehicle files and results.
        unit: SI unit.
        neutral: value at which the effect vanishes.
        lower, upper: physically sensible bounds.
        typical: size met on real vehicles; scales the search and finite differences.
    """

    name: str
    unit: str
    neutral: float
    lower: float
    upper: float
    typical: float


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Attributes:
        name: name of `docs/effects.md`.
        parameters: its numbers.
        per_log: True when its values belong to a flight and not to the vehicle.
        needs: measured channels without which it cannot be seen.
        summary: one sentence for a pilot.
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    summary: str
    per_log: bool = False
    needs: tuple[str, ...] = ()

    def parameter(self, name: str) -> EffectParameter:
        """Returns the parameter called `name`; raises KeyError when there is none."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)


def _axes(names: str, unit: str, bound: float, typical: float) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(n, unit, 0.0, -bound, bound, typical) for n in names.split())


P = EffectParameter
EFFECTS: dict[str, Effect] = {
    e.name: e
    for e in (
        Effect("motor_lag", (P("tau", "s", 0.0, 0.0, 0.3, 0.03),), "The rotors follow their command with a lag."),
        Effect("command_delay", (P("delay", "s", 0.0, 0.0, 0.12, 0.02),), "Commands reach the rotors late."),
        # The vehicle file gives the cutoff; neutral is an infinite cutoff, written by leaving the effect out.
        Effect("imu_lag", (P("cutoff", "Hz", float("inf"), 1.0, float("inf"), 8.0),), "The IMU is filtered and late."),
        Effect("attitude_delay", (P("delay", "s", 0.0, 0.0, 0.12, 0.03),), "The attitude estimate is late."),
        Effect(
            "rotor_drag",
            (P("k_x", "1/s", 0.0, -0.1, 3.0, 0.25), P("k_y", "1/s", 0.0, -0.1, 3.0, 0.25)),
            "The turning rotors drag against sideways flight.",
        ),
        Effect("parasitic_drag", (P("c", "1/m", 0.0, 0.0, 0.5, 0.03),), "The frame has air drag."),
        Effect("rotor_drag_moment", _axes("h_x h_y", "m", 0.3, 0.02), "Rotor drag acts above or below the CG."),
        Effect("rate_damping", _axes("l_p m_q", "1/s", 30.0, 1.0), "Rotation is damped by the air."),
        Effect("axial_inflow", (P("k_z", "1/s", 0.0, -0.5, 3.0, 0.25),), "Thrust falls when climbing."),
        Effect("wind", _axes("north east", "m/s", 30.0, 3.0), "The air moves.", per_log=True),
        Effect(
            "weak_rotor",
            (P("rotor", "", 0.0, 1.0, 12.0, 1.0), P("loss", "", 0.0, -0.6, 0.6, 0.05)),
            "One rotor gives less thrust than the others.",
        ),
        Effect("cg_offset", _axes("x y", "m", 0.1, 0.005), "The centre of gravity is off centre."),
        Effect(
            "mass_change",
            (P("time", "s", float("inf"), 0.0, float("inf"), 1.0), P("fraction", "", 0.0, -0.6, 1.0, 0.1)),
            "Mass was taken up or dropped in flight.",
            per_log=True,
        ),
        Effect(
            "thrust_drop",
            (P("time", "s", float("inf"), 0.0, float("inf"), 1.0), P("fraction", "", 0.0, -0.6, 0.6, 0.1)),
            "All rotors lost thrust at one moment.",
            per_log=True,
        ),
        Effect("battery_sag", (P("fraction", "", 0.0, -0.6, 0.6, 0.1),), "Thrust fades over the flight.", per_log=True),
        Effect(
            "thrust_curve", (P("dead_speed", "rad/s", 0.0, -1000.0, 1000.0, 40.0),), "Thrust is not purely quadratic."
        ),
        Effect("product_of_inertia", _axes("J_xy J_xz J_yz", "kg m^2", 1e-2, 1e-3), "The inertia axes are tilted."),
        Effect(
            "rotor_spin_up",
            (P("J", "kg m^2", 0.0, -1e-3, 1e-3, 5e-5),),
            "Speeding up the rotors turns the vehicle in yaw.",
        ),
        Effect("gyro_bias", _axes("x y z", "rad/s", 0.5, 0.02), "The gyro has an offset.", per_log=True),
        Effect("accel_bias", _axes("x y z", "m/s^2", 5.0, 0.2), "The accelerometer has an offset.", per_log=True),
        Effect("gyro_scale", _axes("x y z", "", 0.5, 0.03), "The gyro has a wrong scale."),
        Effect("imu_misalignment", _axes("x y z", "rad", 0.5, 0.04), "The IMU is mounted askew."),
        Effect("imu_lever_arm", _axes("x y z", "m", 0.5, 0.04), "The IMU sits away from the centre."),
        Effect(
            "ahrs_acceleration_error",
            (P("k", "1/s", 0.0, 0.0, 3.0, 0.2),),
            "The attitude filter is pulled by acceleration.",
        ),
        Effect(
            "ground_effect",
            (P("radius_scale", "", 0.0, -10.0, 10.0, 1.0),),
            "Thrust rises near the ground.",
            needs=("position",),
        ),
    )
}
"""Every effect by name; `docs/effects.md` explains each."""


def known_keys(name: str, rotors: int) -> list[str]:
    """Keys that effect `name` may have in a vehicle file; several weak rotors have ``loss_1``, ``loss_2`` and so on."""
    keys = [p.name for p in EFFECTS[name].parameters]
    return [*keys, *(f"loss_{i + 1}" for i in range(rotors))] if name == "weak_rotor" else keys


def rotor_losses(numbers: Mapping[str, float], rotors: int) -> list[float]:
    """Loss of every rotor, from the numbers of `weak_rotor`: `rotor` and `loss`, or ``loss_1`` … for several.

    Raises:
        ParameterError: no such rotor, or both ways at once.
    """
    rotor, loss = numbers.get("rotor", 0.0), numbers.get("loss", 0.0)
    several = sorted(set(numbers) - {"rotor", "loss"})
    if several and (rotor or loss):
        raise ParameterError(f"weak_rotor: rotor {rotor:g} beside {several[0]}", "rotor and loss, or loss_1, loss_2, …")
    absent = [key for key in several if key not in known_keys("weak_rotor", rotors)]
    if absent:
        raise ParameterError(f"weak_rotor: {absent[0]}", f"loss_1 to loss_{rotors}")
    if loss and not rotor:
        raise ParameterError(f"weak_rotor: loss {loss:g} of no rotor", "rotor beside it", f"say which, 1 to {rotors}")
    if rotor not in range(rotors + 1):
        raise ParameterError(f"weak_rotor: rotor {rotor:g}", f"a whole number from 1 to {rotors}")
    return [numbers.get(f"loss_{i + 1}", loss if rotor == i + 1 else 0.0) for i in range(rotors)]
