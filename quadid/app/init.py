"""Vehicle files to begin with: a template to fill in, or what a log's own parameters describe."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer
from quadid_replay import open_log

from quadid.app.logs import file_name, write_text
from quadid.app.options import Preset, Typed
from quadid.app.outcome import Outcome
from quadid.errors import ParameterError, VehicleError
from quadid.report.tables import Cell, Column, TextTable
from quadid.vehicle import Vehicle

_TEMPLATE = """\
# A vehicle file to fill in; docs/new-vehicle.md has a recipe for every line.
name: {name}
mass: 1.3               # kg  FILL IN: weigh it as it flies
rotors:                 # forward, right, down [m]; spin +1: seen from above it turns counter-clockwise.  FILL IN
  - {{position: [ 0.15,  0.15, 0.0], spin: +1}}
  - {{position: [-0.15, -0.15, 0.0], spin: +1}}
  - {{position: [ 0.15, -0.15, 0.0], spin: -1}}
  - {{position: [-0.15,  0.15, 0.0], spin: -1}}
command: {{kind: rotor_speed, sampling: held}}  # sampling: instant for measured speeds; other kinds:
                        # {{kind: normalized, max_speed: 900}}, {{kind: pwm, range: [1000, 2000], max_speed: 900}}
parameters:             # first guesses, a factor of 4 each way
  b: 1.6e-5             # N s^2/rad^2: mass * 9.81 / (rotors * hover speed^2)
  d: 2.0e-7             # N m s^2/rad^2: b * propeller radius / 6
  J_xx: 1.5e-2          # kg m^2: mass * arm^2 / 4
  J_yy: 1.5e-2
  J_zz: 2.8e-2
  J_r: 4.0e-5
# columns: {{p: gyro_x}}  # what a CSV of yours calls a column
"""


@dataclass(frozen=True, repr=False)
class Initial(Outcome):
    """A vehicle file to fill in; `result` has the form ``quadid.init/1``, its ``file`` None until it is written."""

    result: dict[str, Any]
    content: str

    def __repr__(self) -> str:
        return self.content

    def save(self, path: str | Path) -> Path:
        """Writes the file, unless there is one; returns its absolute path."""
        if Path(path).exists():
            raise VehicleError(f"{path} is there already", "a new file", "choose another name, or remove it")
        return write_text(path, self.content)

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the file under the name of the vehicle."""
        path = self.save(folder / f"{file_name(self.result['vehicle'])}.yaml")
        self.result["file"] = str(path)
        return [("Written", path)]

    @property
    def sentences(self) -> list[Cell]:
        """Next step."""
        blanks = ", ".join(self.result["fill_in"])
        fill = [Cell(f"To fill in: {blanks} (then delete the words FILL IN)")] if blanks else []
        return [*fill, Cell(f"Next: quadid inspect LOG --vehicle {file_name(self.result['vehicle'])}.yaml")]


def init(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the vehicle, and of its file.")],
    log: Annotated[
        str | Path | None,
        Typed(
            str | None,
            typer.Option("--from", metavar="LOG", help="Take geometry, frame, motor order and limits from this log."),
        ),
    ] = None,
    *,
    mass: Annotated[float | None, typer.Option("--mass", metavar="KG", min=0.001, help="Mass as it flies.")] = None,
    arm: Annotated[
        float | None, typer.Option("--arm", metavar="M", min=0.001, help="Distance of the rotors from the centre.")
    ] = None,
    preset: Preset = "auto",
) -> Initial:
    """A vehicle file to fill in.

    Args:
        name: of the vehicle.
        log: its autopilot's parameters give geometry, frame, motor order and limits.
        mass: as it flies [kg].
        arm: distance of the rotors from the centre [m], where the autopilot does not store it.
        preset: topic names of ROS logs.

    Raises:
        LogError: not readable, or neither airframe nor rotor signal in it.
        VehicleError: a name that no vehicle can have.
        ParameterError: a mass or an arm that is not positive.
    """
    for what, size, unit in (("mass", mass, "kg"), ("arm", arm, "m")):
        if size is not None and not (math.isfinite(size) and size > 0.0):
            raise ParameterError(f"{what} {size:g} {unit}", f"more than 0 {unit}")
    if log is None:
        text = _TEMPLATE.format(name=json.dumps(name))
        if mass is not None:
            text = text.replace("mass: 1.3               # kg  FILL IN: weigh it as it flies", f"mass: {mass:g}  # kg")
        Vehicle.from_yaml(text, name)
    else:
        from quadid_replay.vehicle_from_log import vehicle_text

        recording = open_log(Path(log), preset)
        text = vehicle_text(recording, name, mass, arm)
    blanks = [line.split(":")[0].strip(" -#") for line in text.splitlines() if "FILL IN" in line]
    source = None if log is None else str(Path(log).absolute())
    return Initial({"schema": "quadid.init/1", "vehicle": name, "from": source, "fill_in": blanks, "file": None}, text)


@dataclass(frozen=True, repr=False)
class Shipped(Outcome):
    """The vehicles that ship; `result` has the form ``quadid.vehicles/1``."""

    result: dict[str, Any]

    def tables(self) -> list[TextTable]:
        """One row a vehicle."""
        columns = (
            Column("vehicle"), Column("rotors", right=True), Column("mass [kg]", right=True),
            Column("arm [m]", right=True), Column("command", rank=1), Column("description", rank=2),
        )  # fmt: skip
        rows = tuple(
            (r["name"], str(r["rotors"]), f"{r['mass']:.4g}", f"{r['arm']:.3g}", r["command"], r["description"])
            for r in self.records()
        )
        return [TextTable("Vehicles that ship (--vehicle NAME)", columns, rows)]

    def records(self) -> list[dict[str, Any]]:
        """One row a vehicle."""
        return list(self.result["vehicles"])


def vehicles() -> Shipped:
    """Lists the vehicles that ship."""
    return Shipped({"schema": "quadid.vehicles/1", "vehicles": shipped()})


def shipped() -> list[dict[str, Any]]:
    """The vehicles that ship, each with what sets it apart, one row a vehicle."""
    out = []
    for entry in sorted(resources.files("quadid").joinpath("vehicles").iterdir(), key=lambda e: e.name):
        if not entry.name.endswith(".yaml"):
            continue
        text = entry.read_text(encoding="utf-8")
        vehicle = Vehicle.from_yaml(text, entry.name)
        out.append({
            "name": vehicle.name, "rotors": len(vehicle.rotors), "mass": vehicle.mass, "arm": vehicle.arm,
            "command": f"{vehicle.command.kind}, {vehicle.command.sampling}",
            "description": text.splitlines()[0].removeprefix("# ").split(".")[0],
        })  # fmt: skip
    return out
