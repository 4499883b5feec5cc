"""The parameters of a vehicle for another program."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.app.logs import OutputError, file_name, write_texts
from quadid.app.outcome import Outcome
from quadid.effects import EFFECTS
from quadid.errors import QuadidError
from quadid.report.programs import FORMS, form_of, refused
from quadid.report.programs import export as written_as
from quadid.report.tables import Cell, Column, TextTable
from quadid.vehicle import Vehicle

MOST_COLUMNS = 5
"""Forms beside each other that a terminal of 80 characters has room for."""


@dataclass(frozen=True, repr=False)
class Exported(Outcome):
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

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the files; raises OutputError where one would overwrite the vehicle file that was read."""
        for path in (folder / name for name in self.texts):
            if kept is not None and path.exists() and Path(kept).exists() and path.samefile(kept):
                raise OutputError(f"the export would overwrite {kept}", "another folder", "give --out")
        files = self.save(folder)
        self.result["files"] = [str(path) for path in files]
        return [("Written", path) for path in files]


class UnprovenError(QuadidError):
    """Values of a fit that predicted nothing, or predicted badly."""


def export(
    vehicle: str | Path | Vehicle, format: str = "yaml", *, source: str | None = None, anyway: bool = False
) -> Exported:
    """Parameters for another program, with units and where each came from; nothing is sent to a vehicle.

    Args:
        vehicle: a shipped name, a YAML file or a `Vehicle`.
        format: one of `quadid.report.programs.FORMATS`.
        source: where the values come from, for the file; default the vehicle's file or name.
        anyway: write values that are not proven, or in doubt; the top of the file warns of it.

    Raises:
        ParameterError: an unknown format.
        UnprovenError: the values are those of a fit that nothing proves, or in doubt.
        VehicleError: no such vehicle.
    """
    described, format = Vehicle.named(vehicle), form_of(format)
    origin = source or (Path(vehicle).name if isinstance(vehicle, str | Path) else described.name)
    lacking, doubt = (described.proof.lacking, described.proof.doubt) if described.proof else ("", "")
    told = f"{origin} is {'' if doubt else 'not proven: '}{lacking}" if lacking else ""
    if lacking and not anyway:
        proven = "values that predict an unseen flight", "`quadid identify LOG --validate OTHER`, or `quadid diagnose`"
        wanted, fix = ("a set that is in force", "fly on until the service publishes another") if doubt else proven
        raise UnprovenError(told, wanted, f"{fix}; insist with --anyway")
    written = written_as(described, format, origin)
    texts = {f"{file_name(described.name)}{end}": text for end, text in written.items()}
    guessed = [n for n, p in described.parameters.items() if p.sigma is None]
    warnings = [f"{', '.join(guessed)}: guesses from the vehicle file; no flight has shown better"] if guessed else []
    if format in ("px4", "ardupilot") and described.command.max_speed is None:
        warnings.append("no hover thrust: add command.max_speed, the rotor speed at full command, to the vehicle file")
    warnings += [why for why in (refused(described, format), told) if why]
    result = {
        "schema": "quadid.export/1",
        "vehicle": described.name,
        "format": format,
        "files": [],
        "warnings": warnings,
    }
    return Exported(result, texts)


@dataclass(frozen=True, repr=False)
class Forms(Outcome):
    """Contents of each form; `result` has the form ``quadid.formats/1``."""

    result: dict[str, Any]

    def tables(self) -> list[TextTable]:
        """Tables that fit a terminal; what a form does not carry is named in its file."""
        out, others = [], [name for name in FORMS if name != "yaml"]  # yaml carries all
        for part in (others[i : i + MOST_COLUMNS] for i in range(0, len(others), MOST_COLUMNS)):
            rows = [(effect, *("yes" if effect in FORMS[name].carried else "-" for name in part)) for effect in EFFECTS]
            columns = (Column("effect"), *(Column(name) for name in part))
            programs = ", ".join(FORMS[name].program for name in part)
            out.append(TextTable(f"Effects carried to {programs}", columns, tuple(row for row in rows if "yes" in row)))
        return out

    @property
    def sentences(self) -> list[Cell]:
        """Remarks that no table shows."""
        told = "Every form carries mass and geometry; `yaml` carries all. What a form leaves out, its file names."
        return [Cell(told)]


def forms() -> Forms:
    """Contents of each form."""
    carried = {name: {"program": form.program, "effects": list(form.effects)} for name, form in FORMS.items()}
    return Forms({"schema": "quadid.formats/1", "formats": carried})
