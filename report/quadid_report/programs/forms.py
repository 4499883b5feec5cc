"""Every form by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from quadid.effects import EFFECTS
from quadid.errors import ParameterError, nearest
from quadid.vehicle import Vehicle
from quadid_report.programs import agilicious, ardupilot, drone_models, gazebo, isaac_lab, mujoco, px4, rotorpy, urdf
from quadid_report.programs.facts import Facts


class Form(NamedTuple):
    """The form of another program.

    Attributes:
        program: whose.
        carried: effects that it can hold, and optional numbers of these; all others are named in the file as left out.
        texts: makes the text that belongs in a file, by the ending of its name.
    """

    program: str
    carried: tuple[str, ...]
    texts: Mapping[str, Callable[[Facts], str]]

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that it can hold."""
        return tuple(name for name in self.carried if name in EFFECTS)


ALL = (*EFFECTS, *(f"{e.name}.{p.name}" for e in EFFECTS.values() for p in e.parameters), "residual")
"""Everything that a vehicle file holds."""


def _yaml(facts: Facts) -> str:
    head = facts.header(ALL)
    return "".join(f"# {line}\n" for line in head) + facts.vehicle.to_yaml()


FORMS: dict[str, Form] = {
    "yaml": Form("quadid", ALL, {".yaml": _yaml}),
    "px4": Form("PX4, SIH, EKF2", px4.CARRIED, {".params": px4.px4}),
    "ardupilot": Form(
        "ArduPilot, SITL", ardupilot.CARRIED,
        {".param": ardupilot.ardupilot_parameters, ".sitl.json": ardupilot.ardupilot_frame},
    ),
    "gazebo": Form("Gazebo", gazebo.CARRIED, {".sdf": gazebo.gazebo}),
    "rotorpy": Form("RotorPy", rotorpy.CARRIED, {"_params.py": rotorpy.rotorpy}),
    "agilicious": Form("Agilicious", agilicious.CARRIED, {".agilicious.yaml": agilicious.agilicious}),
    "mujoco": Form("MuJoCo", mujoco.CARRIED, {".mjcf.xml": mujoco.mujoco}),
    "urdf": Form("URDF", urdf.CARRIED, {".urdf": urdf.urdf}),
    "drone-models": Form("drone-models, crazyflow", drone_models.CARRIED, {".params.toml": drone_models.drone_models}),
    "isaac-lab": Form("Isaac Lab", isaac_lab.CARRIED, {"_isaaclab.py": isaac_lab.isaac_lab}),
}  # fmt: skip
FORMATS = tuple(FORMS)


def export(vehicle: Vehicle, form: str, source: str) -> dict[str, str]:
    """Writes a vehicle in the form of another program.

    Args:
        vehicle: with its fitted values as initial values.
        form: one of `FORMATS`.
        source: what the vehicle was read from, for the header.

    Returns:
        Text by the ending of the file name it belongs in.

    Raises:
        ParameterError: unknown form.
    """
    if form not in FORMS:
        raise ParameterError(f"unknown format '{form}'", ", ".join(FORMATS), nearest(form, FORMATS))
    facts = Facts(vehicle, source)
    return {end: write(facts) for end, write in FORMS[form].texts.items()}
