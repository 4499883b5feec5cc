"""Every form by name."""

from __future__ import annotations

from quadid.errors import ParameterError, nearest
from quadid.report.programs.agilicious import agilicious
from quadid.report.programs.ardupilot import ardupilot_frame, ardupilot_parameters
from quadid.report.programs.facts import Facts
from quadid.report.programs.gazebo import gazebo
from quadid.report.programs.mujoco import mujoco
from quadid.report.programs.px4 import px4
from quadid.report.programs.rotorpy import rotorpy
from quadid.report.programs.urdf import urdf
from quadid.vehicle import Vehicle

FORMATS = ("yaml", "px4", "ardupilot", "gazebo", "rotorpy", "agilicious", "mujoco", "urdf")


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
    facts = Facts(vehicle, source)
    if form == "yaml":
        return {
            ".yaml": "".join(f"# {line}\n" for line in facts.header((*vehicle.effects, "residual"))) + vehicle.to_yaml()
        }
    if form == "px4":
        return {".params": px4(facts)}
    if form == "ardupilot":
        return {".param": ardupilot_parameters(facts), ".sitl.json": ardupilot_frame(facts)}
    if form == "gazebo":
        return {".sdf": gazebo(facts)}
    if form == "rotorpy":
        return {"_params.py": rotorpy(facts)}
    if form == "agilicious":
        return {".agilicious.yaml": agilicious(facts)}
    if form == "mujoco":
        return {".mjcf.xml": mujoco(facts)}
    if form == "urdf":
        return {".urdf": urdf(facts)}
    raise ParameterError(f"unknown format '{form}'", ", ".join(FORMATS), nearest(form, FORMATS))
