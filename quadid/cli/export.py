"""`quadid export`: the parameters of a vehicle file for another program."""

from pathlib import Path
from typing import Annotated

import typer

from quadid.app.export import export as exported
from quadid.app.export import forms
from quadid.app.options import VEHICLE
from quadid.app.outcome import Outcome
from quadid.report.programs import FORMATS
from quadid.vehicle import Vehicle


def export(
    vehicle: Annotated[str | None, VEHICLE] = None,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="F",
            help=f"{', '.join(FORMATS)}; programs and kinds of files name them too: crazyflow, sdf.",
        ),
    ] = "yaml",
    what: Annotated[bool, typer.Option("--list", help="Print which effects each form carries, and end.")] = False,
    history: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    name: Annotated[str | None, typer.Option("--id", metavar="NAME")] = None,
    anyway: Annotated[bool, typer.Option("--anyway")] = False,
) -> Outcome:
    """Write the parameters for another program, with units and where each came from; nothing is sent to a vehicle.

    Args:
        history: values of the set in force in this history, not of the vehicle file.
        name: name in the history whose set is exported; default the vehicle's.
        anyway: also export values that are unproven or out of date.
    """
    if what:
        return forms()
    if vehicle is None:
        raise typer.BadParameter("no vehicle: use --vehicle, or --list", param_hint="--vehicle")
    described, source = Vehicle.named(vehicle), Path(vehicle).name
    if history is not None:
        described, source = _in_force(described, history, name or described.name)
    elif name is not None:
        raise typer.BadParameter("it names sets of a history: give --history FILE too", param_hint="--id")
    return exported(described, form, source=source, anyway=anyway)


def _in_force(vehicle: Vehicle, history: Path, name: str) -> tuple[Vehicle, str]:
    """The vehicle with the values that a service put in force last and what speaks against, and where they are from."""
    from quadid_node.history import StoreError, read_history, read_in_force

    from quadid.identification.result import with_correlation, with_values
    from quadid.model.layout import ThrustModel
    from quadid.parameters import TANGENT
    from quadid.sanitise import one_line
    from quadid.vehicle import GRAVITY, Proof

    found = read_in_force(history, name, vehicle)
    if found.item is None:
        names = ", ".join(entry["name"] for entry in read_history(history, name, sets=0)["vehicles"]) or "none"
        unread = f": {found.why_none}" if found.why_none else ""
        raise StoreError(f"no set of '{name}' was ever in force in {history}{unread}", f"one of: {names}", "give --id")
    try:
        proof = Proof(verdict="poor", doubt=one_line(found.doubt)) if found.doubt else None
        fitted = with_values(vehicle, found.item.parameters).model_copy(update={"proof": proof})
    except ValueError as error:
        raise StoreError(
            f"set {found.item.sequence} of '{name}' in {history} is no set that a fit makes: {found.why_none}",
            "a set that a service has written",
            "fly on until the service publishes another",
        ) from error
    if TANGENT in found.item.parameters.names:
        # A dead speed in the file gives the slope of thrust at hover.
        b, steep = (found.item.parameters[n].value for n in ("b", TANGENT))
        law = ThrustModel.stated(fitted).with_tangent(steep / b, fitted.mass * GRAVITY)
        prior = fitted.parameters["b"].model_copy(update={"initial": law.curve[0], "bounds": None, "sigma": None})
        curve = {**fitted.effects.get("thrust_curve", {}), "dead_speed": law.curve[1]}
        fitted = fitted.model_copy(
            update={
                "parameters": {**fitted.parameters, "b": prior},
                "effects": {**fitted.effects, "thrust_curve": curve},
            }
        )
    fitted = with_correlation(fitted, found.item.parameters)
    return fitted, f"{history.name}, set {found.item.sequence} of {name}"
