"""The parameters of a vehicle for another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.app.logs import as_vehicle, file_name, write_texts
from quadid.effects import EFFECTS
from quadid.errors import QuadidError
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.report.tables import TextTable


MOST_COLUMNS = 5
"""Forms beside each other that a terminal of 80 characters has room for."""


@dataclass(frozen=True)
class Exported:
    """Files for another program.

    Attributes:
        result: of the form ``quadid.export/1``; ``files`` is empty until they are written.
        texts: content by file name.
    """

    result: dict[str, Any]
    texts: dict[str, str]

    def __repr__(self) -> str:
        return "\n".join(self.texts.values())

    def save(self, folder: str | Path = ".") -> list[Path]:
        """Writes the files into a folder, or a single one under a file name; returns their absolute paths."""
        return write_texts(folder, self.texts)


class UnprovenError(QuadidError):
    """Values of a fit that predicted nothing, or predicted badly."""


def export(
    vehicle: str | Path | Vehicle, format: str = "yaml", *, source: str | None = None, doubt: str = "",
    anyway: bool = False,
) -> Exported:  # fmt: skip
    """Parameters for another program, with units and where each came from; nothing is sent to a vehicle.

    Args:
        vehicle: a shipped name, a YAML file or a `Vehicle`.
        format: one of `quadid.report.programs.FORMATS`.
        source: where the values come from, for the file; default the vehicle's file or name.
        doubt: what speaks against the values, beside the proof in the vehicle file.
        anyway: write the values of a fit that is not proven, or in doubt; the file says so at its top.

    Raises:
        ParameterError: an unknown format.
        UnprovenError: the values are those of a fit that nothing proves, or in doubt.
        VehicleError: no such vehicle.
    """
    from quadid.report.programs import export as written_as
    from quadid.report.programs import form_of, refused

    described, format = as_vehicle(vehicle), form_of(format)
    origin = source or (Path(vehicle).name if isinstance(vehicle, str | Path) else described.name)
    lacking = doubt or (f"not proven: {described.proof.lacking}" if described.proof and described.proof.lacking else "")
    if lacking and not anyway:
        proven = "values that predict an unseen flight", "`quadid identify LOG --validate OTHER`, or `quadid diagnose`"
        wanted, fix = ("a set that is in force", "fly on until the service publishes another") if doubt else proven
        raise UnprovenError(f"{origin} is {lacking}", wanted, f"{fix}; insist with --anyway")
    written = written_as(described, format, origin, doubt)
    texts = {f"{file_name(described.name)}{end}": text for end, text in written.items()}
    guessed = [n for n, p in described.parameters.items() if p.sigma is None]
    warnings = [f"{', '.join(guessed)}: guesses from the vehicle file; no flight was fitted"] if guessed else []
    if format in ("px4", "ardupilot") and described.command.max_speed is None:
        warnings.append("no hover thrust: add command.max_speed, the rotor speed at full command, to the vehicle file")
    warnings += [why for why in (refused(described, format), doubt and f"{origin} is {doubt}") if why]
    result = {
        "schema": "quadid.export/1", "vehicle": described.name, "format": format, "files": [], "warnings": warnings,
    }  # fmt: skip
    return Exported(result, texts)


def forms() -> list[TextTable]:
    """What each form carries, in two tables that fit a terminal; what it does not carry is named in its file."""
    from quadid.report.programs import FORMS
    from quadid.report.tables import Column, TextTable

    out, others = [], [name for name in FORMS if name != "yaml"]  # yaml carries all
    for part in (others[i : i + MOST_COLUMNS] for i in range(0, len(others), MOST_COLUMNS)):
        rows = [(effect, *("yes" if effect in FORMS[name].carried else "-" for name in part)) for effect in EFFECTS]
        columns = (Column("effect"), *(Column(name) for name in part))
        programs = ", ".join(FORMS[name].program for name in part)
        out.append(TextTable(f"Effects carried to {programs}", columns, tuple(row for row in rows if "yes" in row)))
    return out
