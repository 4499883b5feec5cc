"""Every form by name: whose it is, which effects it carries, its templates, and what only it wants to know."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from quadid.effects import EFFECTS
from quadid.errors import ParameterError, nearest
from quadid.vehicle import Vehicle
from quadid_report.programs import particulars
from quadid_report.programs.facts import Facts
from quadid_report.templating import render


class Form(NamedTuple):
    """The form of another program.

    Attributes:
        program: whose.
        carried: effects that it can hold, and optional numbers of these; all others are named in the file as left out.
        templates: name of the template of every file, by the ending of the file's name.
        particulars: what the templates need beside `Facts`; of this vehicle the form cannot hold the effects ``lost``
            and the files ``without``, and ``refused`` says what else it does not write, and why.
    """

    program: str
    carried: tuple[str, ...]
    templates: Mapping[str, str]
    particulars: Callable[[Facts], Mapping[str, Any]] = lambda facts: {}

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that it can hold."""
        return tuple(name for name in self.carried if name in EFFECTS)

    @property
    def names(self) -> set[str]:
        """What people call it: its programs, and the kinds of its files."""
        kinds = {part for end in self.templates for part in end.split(".")[1:]}
        return {*kinds, *self.program.lower().split(", "), *self.program.lower().replace(",", "").split()}


ALL = (*EFFECTS, *(f"{e.name}.{p.name}" for e in EFFECTS.values() for p in e.parameters), "residual")
"""Everything that a vehicle file holds."""
_BODY = ("cg_offset", "product_of_inertia")
_LAGS = ("motor_lag", "motor_lag.tau_down")

FORMS: dict[str, Form] = {
    "yaml": Form("quadid", ALL, {".yaml": "quadid.yaml"}, particulars.own_file),
    "px4": Form(
        "PX4, SIH, EKF2",
        (*_BODY, "weak_rotor", "rotor_drag", "parasitic_drag", "rate_damping", "motor_lag"),
        {".params": "px4.params"},
        particulars.px4,
    ),
    "ardupilot": Form(
        "ArduPilot, SITL",
        ("thrust_curve",),
        {".param": "ardupilot.param", ".sitl.json": "ardupilot.sitl.json"},
        particulars.ardupilot,
    ),
    "gazebo": Form("Gazebo", (*_BODY, *_LAGS, "rotor_drag", "weak_rotor"), {".sdf": "gazebo.sdf"}, particulars.gazebo),
    "rotorpy": Form(
        "RotorPy",
        (*_BODY, "motor_lag", "rotor_drag", "axial_inflow", "parasitic_drag", "imu_lever_arm"),
        {"_params.py": "rotorpy.py"},
    ),
    "agilicious": Form(
        "Agilicious",
        ("cg_offset", "motor_lag", "rotor_drag"),
        {".agilicious.yaml": "agilicious.yaml"},
        particulars.agilicious,
    ),
    "mujoco": Form("MuJoCo", (*_BODY, "weak_rotor"), {".mjcf.xml": "mujoco.mjcf.xml"}),
    "urdf": Form("URDF", _BODY, {".urdf": "vehicle.urdf"}),
    "drone-models": Form(
        "drone-models, crazyflow",
        (*_BODY, *_LAGS, "rotor_drag", "rotor_drag.central", "axial_inflow", "axial_inflow.central"),
        {".params.toml": "drone_models.toml"},
        particulars.drone_models,
    ),
    "isaac-lab": Form("Isaac Lab", (*_BODY, *_LAGS), {"_isaaclab.py": "isaac_lab.py"}, particulars.isaac_lab),
}
FORMATS = tuple(FORMS)


def form_of(name: str) -> str:
    """The form of that name, program or kind of file (``sdf``, ``crazyflow``).

    Raises:
        ParameterError: no form, or several.
    """
    if name in FORMS:
        return name
    asked = name.lower().lstrip(".")
    found = [form for form, about in FORMS.items() if asked in about.names]
    if len(found) != 1:
        raise ParameterError(f"unknown format '{name}'", ", ".join(FORMATS), nearest(name, FORMATS))
    return found[0]


def refused(vehicle: Vehicle, form: str) -> str:
    """What a form does not write of this vehicle, and why; empty where it writes all it has."""
    return str(FORMS[form_of(form)].particulars(Facts(vehicle, "")).get("refused", ""))


def export(vehicle: Vehicle, form: str, source: str, doubt: str = "") -> dict[str, str]:
    """Writes a vehicle in the form of another program.

    Args:
        vehicle: with its fitted values as initial values.
        form: one of `FORMATS`, or what `form_of` takes for one.
        source: what the vehicle was read from, for the header.
        doubt: what speaks against the values, for the header.

    Returns:
        Text by the ending of the file name it belongs in.

    Raises:
        ParameterError: unknown form, or a vehicle that it cannot hold.
    """
    facts, asked = Facts(vehicle, source, doubt), FORMS[form_of(form)]
    own = asked.particulars(facts)
    header = facts.header(tuple(name for name in asked.carried if name not in own.get("lost", ())))
    values = {**own, "f": facts, "v": vehicle, "rotors": facts.rotors, "header": header}
    without = own.get("without", ())
    return {end: render(f"programs/{name}", values) for end, name in asked.templates.items() if end not in without}
