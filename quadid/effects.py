"""Catalogue of effects that a simulation may lack: one table with all properties of each.

Vocabulary of vehicle file, model, diagnosis, reports and flown truth.  Equations are elsewhere: those of the model
under test in `quadid.model`, those of the flown vehicle in `quadid.flight`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from quadid.errors import ParameterError, nearest

# --- What one entry of the table of effects holds


Acts = Literal["command", "rotor", "air", "body", "flight", "sensor"]
Scale = Literal["", "arm", "inertia", "rotor_inertia", "hover_speed", "rotor_weight"]


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        name: name inside the effect, as written in vehicle files and results.
        unit: SI unit.
        neutral: value at which the effect vanishes.
        lower, upper: physically sensible bounds.
        typical: size met on real vehicles: unit of the search, of finite differences and of the prior.
        start: where the search begins, in the vector's unit; 0: at neutral, where the model is linear in it.
        sign: +1 where physics keeps it from being negative.
        scale: what its size goes with on other airframes.
        factor: to the unit of the sentence.
        optional: stays at neutral until data ask for it beside the effect's other numbers.
        flexible: free in the model that is to leave only noise, where its effect is; not what doubles d and J_zz there.
        entry: its name in the parameter vector, where that holds another form of it.
        beside: parameter of the same effect which it replaces in part; it is that one's value plus its vector entry,
            and that one's value where a vehicle file leaves it out.
    """

    name: str
    unit: str
    neutral: float
    lower: float
    upper: float
    typical: float
    start: float = 0.0
    sign: int = 0
    scale: Scale = ""
    factor: float = 1.0
    optional: bool = False
    flexible: bool = True
    entry: str = ""
    beside: str = ""


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Attributes:
        name: name of `docs/effects.md`.
        acts: where: on the way from command to rotor speed, at the rotor, through the air (velocity matters), on the
            body, at some time of one flight, or in a sensor (the motion stays).
        parameters: its numbers.
        summary: one sentence for a pilot.
        sentence: one with numbers, of a finding.
        advice: what a pilot or builder can do about it, beside putting it into the model.
        shows: residuals that show it, ``channel: against``; ``channel'`` is the residual's rate of change.
        family: look-alikes, which are compared with each other; default none but itself.
        requires: effect without which it cannot be seen.
        needs: measured channels without which it cannot be seen; rotor columns that are commands, or readings.
        per_log: its values belong to a flight and not to the vehicle.
        memory: it needs a stretch before a segment in which it settles.
        flexible: whether it is free in the model that is to leave only noise; not what doubles another effect or needs
            a time.
        sized: a data sheet bounds it.
        constant_on: kind of channel on which it claims a constant offset.
        ties: two nominal parameters of which no more than the ratio shows where this acts.
    """

    name: str
    acts: Acts
    parameters: tuple[EffectParameter, ...]
    summary: str
    sentence: str
    advice: str
    shows: tuple[str, ...]
    family: str = ""
    requires: str | None = None
    needs: tuple[str, ...] = ()
    per_log: bool = False
    memory: bool = False
    flexible: Literal["always", "with_velocity", "never"] = "always"
    sized: bool = False
    constant_on: str = ""
    ties: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """An effect without look-alikes is a family of its own."""
        if not self.family:
            object.__setattr__(self, "family", self.name)

    def parameter(self, name: str) -> EffectParameter:
        """Returns the parameter called `name`; raises KeyError when there is none."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)

    @property
    def timed(self) -> bool:
        """Checks whether it begins at an unknown moment."""
        return any(p.name == "time" for p in self.parameters)

    @property
    def turns(self) -> bool:
        """Checks whether angular acceleration shows it, from which a moment of inertia is estimated."""
        return any("':" in s or s.endswith("_dot") for s in self.shows)

    @property
    def needs_fast_rotors(self) -> bool:
        """True if a rotor signal too slow for inertias hides it: a lag or delay is over before the next sample."""
        return self.family == "late"

    @property
    def refinements(self) -> tuple[str, ...]:
        """Names in the parameter vector of its optional numbers."""
        return tuple(f"{self.name}.{p.entry or p.name}" for p in self.parameters if p.optional)

    @property
    def entries(self) -> tuple[str, ...]:
        """Its names in the parameter vector, times and optional ones left out."""
        return tuple(f"{self.name}.{p.entry or p.name}" for p in self.parameters if p.name != "time" and not p.optional)

    @property
    def flexible_entries(self) -> tuple[str, ...]:
        """Those of `entries` that are free in the model that is to leave only noise."""
        rigid = {f"{self.name}.{p.entry or p.name}" for p in self.parameters if not p.flexible}
        return tuple(name for name in self.entries if name not in rigid)

    @property
    def start(self) -> tuple[float, ...]:
        """Start of a search over `entries`; none: at neutral."""
        start = tuple(p.start for p in self.parameters if p.name != "time" and not p.optional)
        return start if any(start) else ()

    def describe(self, values: Mapping[str, float]) -> str:
        """The sentence with these values, in contract units."""
        factor = {p.name: p.factor for p in self.parameters}
        return self.sentence.format(**{k: v * factor.get(k, 1.0) for k, v in values.items()})


# --- The table itself: one entry an effect.  Order is that of the parameter vector and of result pages
#
# Sizes are those of a Pelican (1.3 kg, 0.21 m arms); `scale` carries them to other airframes.


P = EffectParameter
NEVER = 1e9
"""Stands for "not in this log" in times of change [s]."""


def _axes(names: str, unit: str, bound: float, typical: float, **more: object) -> tuple[EffectParameter, ...]:
    return tuple(P(n, unit, 0.0, -bound, bound, typical, **more) for n in names.split())  # type: ignore[arg-type]


def _change(*fractions: EffectParameter) -> tuple[EffectParameter, ...]:
    return (P("time", "s", float("inf"), 0.0, float("inf"), 1.0), *fractions)


_CENTRAL = P("central", "", 0.0, -0.5, 1.5, 0.3, optional=True)
"""By how much of its arm the air of a hub acts nearer to the centre of gravity; 1 in simulators without hubs."""
_TURNS = ("p: p_dot", "q: q_dot", "r: r_dot")
_STEPS = ("a_z: time", "p': time", "q': time", "r': time")
_CORNER = ("p': thrust", "q': thrust", "r': thrust", "p': time")
_DRAGS = ("a_x: v_x", "a_y: v_y", "a_x: time", "a_y: time")

TABLE: tuple[Effect, ...] = (
    Effect(
        "motor_lag", "command", (
            P("tau", "s", 0.0, 0.0, 0.3, 0.03, start=0.02, factor=1e3),
            P("tau_down", "s", 0.0, -0.1, 0.3, 0.02, optional=True, entry="slower", beside="tau", factor=1e3),
        ),
        summary="The rotors follow their command with a lag.",
        sentence="the rotors need {tau:.0f} ms to follow a command (first-order lag), seen as late rotation and thrust",
        advice="Usual for real motors; a controller can compensate it.",
        family="late", shows=(*_TURNS, "a_z: thrust_rate"),
    ),
    Effect(
        "command_delay", "command", (P("delay", "s", 0.0, 0.0, 0.12, 0.02, start=0.015, factor=1e3),),
        summary="Commands reach the rotors late.",
        sentence="commands reach the rotors {delay:.0f} ms late, seen as a pure delay of rotation and thrust",
        advice="Look for buffering between controller and speed controllers: protocol, loop rates, filters.",
        family="late", flexible="never", shows=(*_TURNS, "a_z: thrust_rate"),
    ),
    Effect(
        "imu_lag", "sensor", (P("cutoff", "Hz", float("inf"), 1.0, float("inf"), 8.0, start=0.10, entry="period"),),
        summary="The IMU is filtered and late.",
        sentence="gyro and accelerometer are low-passed at {cutoff:.1f} Hz and so lag behind the attitude",
        advice="Check the gyro's low-pass and notch filters; log unfiltered where possible.",
        family="late", memory=True, shows=(*_TURNS, "a_z: thrust_rate"),
    ),
    Effect(
        "attitude_delay", "sensor", (P("delay", "s", 0.0, 0.0, 0.12, 0.03, start=0.02, factor=1e3),),
        summary="The attitude estimate is late.",
        sentence="the attitude estimate arrives {delay:.0f} ms late against the integrated gyro",
        advice="Check the attitude estimator's rate and the telemetry path.",
        family="late", memory=True, shows=("phi: p", "theta: q", "psi: r"),
    ),
    Effect(
        "rotor_drag", "air",
        (*(P(n, "1/s", 0.0, -0.1, 3.0, 0.25, start=0.2, sign=1) for n in ("k_x", "k_y")), _CENTRAL),
        summary="The turning rotors drag against sideways flight.",
        sentence="the rotors drag against sideways flight by {k_x:.2f} and {k_y:.2f} m/s^2 for each m/s",
        advice="Normal on every multirotor: keep it in the model, or the simulated vehicle coasts too far.",
        family="drag", shows=_DRAGS,
    ),
    Effect(
        "parasitic_drag", "air",
        (
            P("c", "1/m", 0.0, 0.0, 0.5, 0.03, start=0.03),
            P("c_z", "1/m", 0.0, -0.5, 1.0, 0.03, optional=True, entry="beside_z", beside="c"),
        ),
        summary="The frame has air drag.",
        sentence="the frame's air drag grows with the square of speed, {c:.3f} 1/m",
        advice="Normal at speed: keep it in the model, or the simulated vehicle flies too fast.",
        family="drag", flexible="with_velocity", shows=(*_DRAGS, "a_z: v_z"),
    ),
    Effect(
        "translational_lift", "air", (P("k", "1/m", 0.0, 0.0, 0.3, 0.02, start=0.02),),
        summary="Thrust rises in sideways flight.",
        sentence="thrust rises by {k:.3f} m/s^2 for each (m/s)^2 of sideways speed",
        advice="Normal at speed, where the rotors meet fresh air: without it the simulated vehicle sinks.",
        needs=("velocity",), flexible="with_velocity", shows=("a_z: v_x", "a_z: v_y"),
    ),
    Effect(
        "rotor_drag_moment", "air", _axes("h_x h_y", "m", 0.3, 0.02, scale="arm", factor=1e3),
        summary="Rotor drag acts above or below the CG.",
        sentence="rotor drag acts {h_x:.1f} and {h_y:.1f} mm off the centre of gravity and tilts the vehicle in "
        "sideways flight",
        advice="The rotors sit above or below the centre of gravity; moving the battery changes it.",
        requires="rotor_drag", shows=("q': v_x", "p': v_y", "p': time", "q': time"),
    ),
    Effect(
        "rate_damping", "body",
        (*_axes("l_p m_q", "1/s", 30.0, 1.0, sign=1), *_axes("n_r", "1/s", 30.0, 1.0, sign=1, flexible=False)),
        summary="Rotation is damped, by more than the air at each hub.",
        sentence="roll, pitch and yaw rotation is damped by {l_p:.2f}, {m_q:.2f} and {n_r:.2f} 1/s beyond the "
        "damping of the rotors",
        advice="Usual for a large frame; beyond that look for an unmodelled lag.",
        shows=("p': p", "q': q", "r': r"),
    ),
    Effect(
        "axial_inflow", "air", (
            P("k_z", "1/s", 0.0, -0.5, 3.0, 0.25, start=0.2, sign=1),
            P("k_climb", "1/m", 0.0, -0.1, 0.5, 0.03, optional=True, sign=1),
            _CENTRAL,
        ),
        summary="Thrust falls when climbing.",
        sentence="thrust falls by {k_z:.2f} m/s^2 for each m/s of climb",
        advice="Usual; matters for climbs and descents.",
        shows=("a_z: v_z", "a_z: thrust", "a_z: time"),
    ),
    Effect(
        "wind", "air", _axes("north east", "m/s", 30.0, 3.0),
        summary="The air moves.",
        sentence="the air moved by {north:.1f} m/s north and {east:.1f} m/s east",
        advice="Belongs to that day. Fly in calm air, or in several directions.",
        per_log=True, needs=("velocity",), requires="rotor_drag", flexible="never",
        shows=(*_DRAGS, "a_x: heading", "a_y: heading"),
    ),
    Effect(
        "weak_rotor", "rotor",
        (
            P("rotor", "", 0.0, 1.0, 16.0, 1.0),
            P("loss", "", 0.0, -0.6, 0.6, 0.05, sign=1, factor=1e2),
            P("drag_loss", "", 0.0, -1.0, 1.0, 0.1, optional=True, entry="extra", beside="loss", factor=1e2),
        ),
        summary="One rotor produces less thrust than the others.",
        sentence="rotor {rotor:.0f} produces {loss:.1f} % less thrust and drag torque than the others",
        advice="Check that rotor: propeller, motor, speed controller, arm.",
        family="corner", flexible="never", shows=_CORNER,
    ),
    Effect(
        "cg_offset", "body", _axes("x y", "m", 0.1, 0.005, scale="arm", factor=1e3),
        summary="The centre of gravity is off centre.",
        sentence="the centre of gravity lies {x:.1f} mm forward and {y:.1f} mm to the right of the geometric centre",
        advice="Move the battery or the payload, or update the controller.",
        family="corner", shows=_CORNER,
    ),
    Effect(
        "mass_change", "flight", _change(
            P("fraction", "", 0.0, -0.6, 1.0, 0.1, factor=1e2),
            *(P(f"J_{a}", "", 0.0, -0.6, 2.0, 0.1, optional=True, factor=1e2) for a in ("xx", "yy", "zz")),
            *(P(a, "m", 0.0, -0.1, 0.1, 0.005, optional=True, scale="arm", factor=1e3) for a in ("x", "y")),
        ),
        summary="Mass was taken up or dropped in flight.",
        sentence="at {time:.1f} s the mass changed by {fraction:.1f} %",
        advice="Check the payload and its release.",
        family="step", per_log=True, flexible="never", shows=_STEPS,
    ),
    Effect(
        "thrust_drop", "flight", _change(P("fraction", "", 0.0, -0.6, 0.6, 0.1, factor=1e2)),
        summary="All rotors lost thrust at one moment.",
        sentence="at {time:.1f} s all rotors lost {fraction:.1f} % of their thrust",
        advice="Look for a voltage drop or a thermal limit at that moment.",
        family="step", per_log=True, flexible="never", shows=_STEPS,
    ),
    Effect(
        "battery_sag", "flight", (P("fraction", "", 0.0, -0.6, 0.6, 0.1, factor=1e2),),
        summary="Thrust fades over the flight.",
        sentence="thrust at the same command faded by {fraction:.1f} % from the first to the last sample",
        advice="Compensate thrust for voltage, or log measured rotor speeds.",
        family="step", per_log=True, shows=_STEPS,
    ),
    Effect(
        "thrust_curve", "rotor", (
            P("dead_speed", "rad/s", 0.0, -1000.0, 1000.0, 40.0, scale="hover_speed"),
            P("offset", "N", 0.0, -1.0, 1.0, 0.1, optional=True, scale="rotor_weight"),
        ),
        summary="Thrust is not purely quadratic.",
        sentence="thrust follows (speed - {dead_speed:.0f} rad/s)^2 rather than speed^2",
        advice="Measure thrust against command on a stand, or log measured rotor speeds.",
        shows=("a_z: rotor_speed", "p': rotor_speed"),
    ),
    Effect(
        "supply_voltage", "command", (P("exponent", "", 0.0, -1.0, 3.0, 0.5, start=1.0),),
        summary="The rotors turn slower as the battery empties.",
        sentence="rotor speed goes with the supply voltage to the power of {exponent:.2f}",
        advice="Compensate commands for voltage, or log measured rotor speeds.",
        family="step", needs=("battery", "commands"), flexible="never", shows=("a_z: time",),
    ),
    Effect(
        "rotor_telemetry_delay", "command", (P("delay", "s", 0.0, 0.0, 0.06, 0.01, start=0.005, factor=1e3),),
        summary="Measured rotor speeds are reported late.",
        sentence="measured rotor speeds are reported {delay:.0f} ms late",
        advice="Look for buffering between the speed controllers and the log.",
        family="late", needs=("readings",), flexible="never", shows=_TURNS,
    ),
    Effect(
        "drag_torque_curve", "rotor", (P("growth", "", 0.0, -2.0, 3.0, 0.5),),
        summary="The rotors' drag torque is not purely quadratic.",
        sentence="the rotors' drag torque grows with speed to the power of {growth:.2f} beyond the square, about hover",
        advice="Measure torque against speed on a stand; in some simulators it is proportional to thrust and command.",
        flexible="never", shows=("r': rotor_speed", "r': thrust"),
    ),
    Effect(
        "no_gyroscopic_coupling", "body", (P("share", "", 0.0, -0.5, 1.5, 0.3, factor=1e2),),
        summary="Rotation about one axis does not couple into the others.",
        sentence="{share:.0f} % of the gyroscopic coupling of the body's rotation is missing",
        advice="No real vehicle does this: the data are from a simulator that omits the term.",
        flexible="never", shows=("p': q", "q': r", "r': p"), ties=("d", "J_zz"),
    ),
    Effect(
        "product_of_inertia", "body", _axes("J_xy J_xz J_yz", "kg m^2", 1e-2, 1e-3, scale="inertia"),
        summary="The inertia axes are tilted.",
        sentence="the inertia axes are tilted: a moment about one axis also turns another",
        advice="The mass is not symmetric; check the mounting of battery and payload.",
        shows=("p': q_dot", "p': r_dot", "q': p_dot", "q': r_dot", "r': p_dot", "r': q_dot"),
    ),
    Effect(
        "rotor_spin_up", "body", (P("J", "kg m^2", 0.0, -1e-3, 1e-3, 5e-5, sign=1, scale="rotor_inertia"),),
        summary="Speeding up the rotors turns the vehicle in yaw.",
        sentence="speeding the rotors up or down turns the vehicle in yaw (rotor inertia {J:.2e} kg m^2)",
        advice="Usual; it makes yaw quicker than drag torque alone would.",
        shows=("r': spin_rate",),
    ),
    Effect(
        "gyro_bias", "sensor", _axes("x y z", "rad/s", 0.5, 0.02),
        summary="The gyro has an offset.",
        sentence="the gyro reads {x:.4f}, {y:.4f}, {z:.4f} rad/s too much",
        advice="Calibrate the gyro before take-off, warm.",
        per_log=True, sized=True, constant_on="gyro",
        shows=tuple(f"{c}: time" for c in ("p", "q", "r", "phi", "theta", "psi")),
    ),
    Effect(
        "accel_bias", "sensor", _axes("x y z", "m/s^2", 5.0, 0.2),
        summary="The accelerometer has an offset.",
        sentence="the accelerometer reads {x:.2f}, {y:.2f}, {z:.2f} m/s^2 too much",
        advice="Calibrate the accelerometer.",
        per_log=True, sized=True, constant_on="force", shows=tuple(f"{c}: time" for c in ("a_x", "a_y", "a_z")),
    ),
    Effect(
        "gyro_scale", "sensor", _axes("x y z", "", 0.5, 0.03, factor=1e2),
        summary="The gyro has a wrong scale.",
        sentence="the gyro's scale is off by {x:.1f}, {y:.1f}, {z:.1f} %",
        advice="Calibrate the gyro's scale on a turntable.",
        sized=True, shows=("p: p", "q: q", "r: r"),
    ),
    Effect(
        "imu_misalignment", "sensor", _axes("x y z", "rad", 0.5, 0.04, factor=57.29578),
        summary="The IMU is mounted askew.",
        sentence="the IMU is turned against the body by {x:.1f}, {y:.1f}, {z:.1f} degrees",
        advice="Check the mounting, or set the board rotation.",
        sized=True,
        shows=("a_x: thrust", "a_y: thrust", "p: q", "p: r", "q: r", "q: p", "r: p", "r: q"),
    ),
    Effect(
        "imu_lever_arm", "sensor", _axes("x y z", "m", 0.5, 0.04, scale="arm", factor=1e3),
        summary="The IMU sits away from the centre.",
        sentence="the accelerometer sits {x:.0f}, {y:.0f}, {z:.0f} mm from the geometric centre",
        advice="Set the IMU position in the estimator.",
        shows=tuple(f"{c}: {s}" for c in ("a_x", "a_y", "a_z") for s in ("p_dot", "q_dot", "r_dot")),
    ),
    Effect(
        "ahrs_acceleration_error", "sensor", (P("k", "1/s", 0.0, 0.0, 3.0, 0.2),),
        summary="The attitude filter is pulled by acceleration.",
        sentence="the attitude filter is pulled towards the accelerometer's level with {k:.2f} 1/s",
        advice="Lower the accelerometer's weight in the attitude estimator.",
        shows=("phi: time", "theta: time", "theta: v_x"),
    ),
    Effect(
        "ground_effect", "air", (P("radius_scale", "", 0.0, -10.0, 10.0, 1.0, start=1.0),),
        summary="Thrust rises near the ground.",
        sentence="thrust rises near the ground (rotor radius scale {radius_scale:.2f})",
        advice="Fly higher to identify, or keep it in the model for landing.",
        needs=("position",), flexible="never", shows=("a_z: height", "a_z: time"),
    ),
    Effect(
        "velocity_scale", "sensor", _axes("horizontal vertical", "", 0.5, 0.05, factor=1e2),
        summary="The logged velocity has a wrong scale.",
        sentence="the logged velocity is {horizontal:.1f} % too large horizontally, {vertical:.1f} % vertically",
        advice="Check the scale of the estimator's velocity: height of the flow sensor, marker distances.",
        needs=("velocity", "position"), flexible="never", sized=True, shows=("v_n: v_n", "v_e: v_e", "v_d: v_d"),
    ),
)  # fmt: skip


EFFECTS: dict[str, Effect] = {e.name: e for e in TABLE}
"""Every effect by name; `docs/effects.md` explains each."""


def parameter_of(effect: str, key: str) -> EffectParameter:
    """The parameter called `key` of an effect.

    Raises:
        ParameterError: there is none.
    """
    known = [p.name for p in EFFECTS[effect].parameters]
    if key not in known:
        raise ParameterError(f"effect '{effect}' has no parameter '{key}'", ", ".join(known), nearest(key, known))
    return EFFECTS[effect].parameter(key)


def known_keys(name: str, rotors: int) -> list[str]:
    """Keys that effect `name` may have in a vehicle file; several weak rotors have ``loss_1``, ``drag_loss_1``, …."""
    keys = [p.name for p in EFFECTS[name].parameters]
    each = [f"{key}_{i + 1}" for i in range(rotors) for key in ("loss", "drag_loss")]
    return [*keys, *each] if name == "weak_rotor" else keys


def butterworth_delay(cutoff: float) -> float:
    """Delay [s] of slow motion behind `imu_lag` with a cutoff [Hz]; of a delay, the cutoff."""
    return math.sqrt(0.5) / (math.pi * cutoff)


def rotor_losses(numbers: Mapping[str, float], rotors: int) -> list[float]:
    """Loss of every rotor, from the numbers of `weak_rotor`: `rotor` and `loss`, or ``loss_1`` … for several.

    Raises:
        ParameterError: no such rotor, or both ways at once.
    """
    rotor, loss = numbers.get("rotor", 0.0), numbers.get("loss", 0.0)
    several = sorted(set(numbers) - {"rotor", "loss", "drag_loss"})
    if several and (rotor or loss):
        raise ParameterError(f"weak_rotor: rotor {rotor:g} beside {several[0]}", "rotor and loss, or loss_1, loss_2, …")
    absent = [key for key in several if key not in known_keys("weak_rotor", rotors)]
    if absent:
        raise ParameterError(f"weak_rotor: {absent[0]}", f"loss_1 to loss_{rotors}")
    if (loss or numbers.get("drag_loss")) and not rotor:
        raise ParameterError(f"weak_rotor: loss {loss:g} of no rotor", "rotor beside it", f"say which, 1 to {rotors}")
    if rotor not in range(rotors + 1):
        raise ParameterError(f"weak_rotor: rotor {rotor:g}", f"a whole number from 1 to {rotors}")
    return [numbers.get(f"loss_{i + 1}", loss if rotor == i + 1 else 0.0) for i in range(rotors)]


def rotor_drag_losses(numbers: Mapping[str, float], rotors: int) -> list[float]:
    """Share of its drag torque that every rotor lost: as its thrust, unless `drag_loss`, or ``drag_loss_1`` …, differ.

    Raises:
        ParameterError: as `rotor_losses`.
    """
    out = rotor_losses(numbers, rotors)
    for i in range(rotors):
        alone = "drag_loss" if numbers.get("rotor") == i + 1 else f"drag_loss_{i + 1}"
        out[i] = numbers.get(alone, out[i])
    return out
