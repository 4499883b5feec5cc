"""Diagnosis: what the simulation gets wrong, why, and what the better model gains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from quadid.app.identify import OPTIMIZERS, check_seed, out_of_reach, proven, search
from quadid.app.logs import file_name, settled
from quadid.app.missing import compared
from quadid.app.options import Logs, OfVehicle, Seed, Validate
from quadid.app.outcome import LIBRARY, NUMBER_COLUMNS, Advance, Fitted, number_rows, provenance, quality, silent
from quadid.checks.findings import farthest
from quadid.effects import EFFECTS
from quadid.model.layout import Layout, with_reference_voltage
from quadid.parameters import INERTIAS, NOMINAL_NAMES, Status, unreliable
from quadid.report.tables import Cell, TextTable, heads, number, parameter_table
from quadid.report.verdict import Verdict, digits
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.diagnosis import Diagnosis
    from quadid.diagnosis.search import Search
    from quadid.identification.noise import NoiseModel
    from quadid.report.figures import ResidualMap


@dataclass(frozen=True, repr=False)
class Diagnosed(Fitted):
    """Result of a diagnosis.

    Attributes:
        result: of the form ``quadid.diagnose/1``; ``vehicle_file`` is None until a file is written.
        sets: logs scored without and with the findings.
        nominal: vehicle that was given.
        search: how the causes were selected.
    """

    title = "Diagnosis"
    columns = (*NUMBER_COLUMNS, "mse_before", "mse_after", "p_value")
    found: Diagnosis
    noise: NoiseModel
    nominal: Vehicle
    search: Search

    @property
    def vehicle(self) -> Vehicle:
        """The fitted vehicle with the findings in it; ``vehicle.save("mine.yaml")`` writes it."""
        unseen = self.result["validation"]
        sets = [
            {"log": log.name, "role": s.role, "mse": {"fitted": unseen["mse_extended"]}}
            for log, s in zip(self.logs, self.sets, strict=True)
        ]
        return proven(self.found.vehicle, self.nominal, self.verdict, sets, self.train, self.beside)

    @property
    def file_name(self) -> str:
        """``pelican+motor_lag.yaml``, or ``pelican.diagnosed.yaml`` without findings: no file of an identification."""
        return f"{file_name(self.found.vehicle_name)}{'' if self.found.findings else '.diagnosed'}.yaml"

    @property
    def verdict(self) -> Verdict:
        """Checks whether the model may be used, and what to do next."""
        from quadid.report.fit_pages import diagnose_verdict

        return diagnose_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """The findings, then the parameters beside them."""
        findings, parameters = self.result["findings"], self.result.get("parameters")
        rows = []
        for finding in findings:
            gain, rival = finding["gain"], min(finding["alternatives"], key=lambda a: a["mse_after"], default=None)
            name = Cell(finding["effect"].replace("_", " "), "" if finding["confident"] else "fair")
            other = f"{rival['effect'].replace('_', ' ')} ({number(rival['mse_after'], 3)})" if rival else ""
            about = (name, number(gain["mse_before"], 3), number(gain["mse_after"], 3), other)
            for i, p in enumerate(finding["parameters"]):
                value, limits = f"rotor {p['value']:.0f}", ""
                if p["name"] != "rotor":
                    value = f"{p['name']} = {number(p['value'], digits(p))} {p['unit']}".rstrip()
                    limits = " .. ".join(number(end, digits(p)) for end in p["ci95"] or (None, None))
                first, before, after, rejected = about if i == 0 else ("",) * 4
                rows.append((first, value, before, after, limits, rejected))
        columns = heads("cause | value | without > | with > | 95 % interval <2 | rejected alternative <1")
        runs = ", ".join(dict.fromkeys(f"{f['gain']['seconds']:g} s" for f in findings))
        title = f"What the simulation gets wrong (error of {runs} runs in noise variances, 1 = noise floor)"
        named = [TextTable(title, columns, tuple(rows))] if findings else []
        return [*named, *([parameter_table(parameters)] if parameters else [])]

    def records(self) -> list[dict[str, Any]]:
        """One row a number of a finding."""
        return number_rows(self.result["findings"], self.columns)

    def plot(self, log: int = -1, group: str = "rates") -> Any:
        """Measured and simulated outputs of one log, without and with the findings, as a plotly figure."""
        from quadid.report.figures import MODELS, channel_plot

        return channel_plot(self.sets[log], group, MODELS)

    def page(self, command: str = LIBRARY) -> str:
        """The page: findings with their pictures, parameters, residuals."""
        from quadid.report.fit_pages import diagnosis_part, findings_section, parameter_section, quality_section

        file = self.result["vehicle_file"] or "not written"
        rows = provenance(self.logs, command, {"seed": self.result["seed"], "vehicle file": file})
        parameters = self.result.get("parameters")
        sections = [
            None if self.forces is None else self.forces.section(),
            parameter_section(parameters) if parameters else None,
            findings_section([diagnosis_part(self.result, self.sets, maps=self.maps(), judged=False)]),
            quality_section([quality(log) for log in self.logs], self.noise),
        ]
        return self.rendered(f"Diagnosis of {self.nominal.name}", self.used("diagnosed"), sections, rows)

    def maps(self) -> dict[str, ResidualMap]:
        """Picture of every cause in the residual of the diagnosed logs, by name of the effect."""
        from quadid.report.figures import residual_map

        windows = [w for log in self.train for w in log.windows]
        model = self.search.model
        drawn = {
            c.effect: residual_map(windows, self.nominal, model.theta, c.effect, c.names, self.noise)
            for c in model.causes
        }
        return {effect: one for effect, one in drawn.items() if one is not None}


def diagnose(
    logs: Logs, validate: Validate = (), *, vehicle: OfVehicle = None, seed: Seed = 1, advance: Advance = silent
) -> Diagnosed:
    """Names what the simulation gets wrong, extends the model by it, and measures the gain on unseen data.

    Args:
        logs: a log or several to diagnose, as paths or from `load`.
        validate: flights to measure the gain on; without any, held-out blocks of `logs` serve.
        vehicle: nominal vehicle; default that of the first loaded log.
        seed: of all random numbers.
        advance: called with the stage and the share done.

    Raises:
        NotIdentifiableError: too little data.
        LogError: a log that does not fit the vehicle.
    """
    from quadid.diagnosis.pipeline import LEAST_REMOVED
    from quadid.diagnosis.pipeline import diagnose as diagnose_windows
    from quadid.diagnosis.result import Explanation
    from quadid.identification.result import ScoredSet, mse_score, parameter_entry, with_values
    from quadid.report.fit_pages import diagnose_verdict

    check_seed(seed)
    given = settled(logs, validate, vehicle)
    described, train, held = given.vehicle, given.train, given.held
    windows, unseen = ([w for log in part for w in log.windows] for part in (train, held))
    unreachable = out_of_reach(train)
    # One flight has one error: what `quadid identify` states for it, and what the findings make of that.
    fit = search(
        OPTIMIZERS[0],
        windows,
        with_reference_voltage(described, windows),
        seed,
        lambda _, share: advance("nominal fit", share),
        unreachable,
    )
    found, selection = diagnose_windows(windows, described, unseen, seed, advance, nominal=fit)
    found, model = _within_reach(found, unreachable, farthest([log.off for log in train])), selection.model
    models = {"nominal": fit.theta, "extended": model.theta}
    # What force and moment the vehicle misses without and with the causes: too little taken off, and none is confident.
    forces, squares = compared(train, held, fit.vehicle, models, {}, advance)
    # Share that the confident findings take on flights that were not fitted, or without any all of them.
    sure = {f.effect for f in found.findings if f.confident} or {f.effect for f in found.findings}
    doubtful = [n for c in model.causes if c.effect not in sure for n in c.names]
    removed = None if forces is None else forces.taken("nominal", Layout(fit.vehicle).without(model.theta, doubtful))
    if found.verdict is Explanation.PARTLY_EXPLAINED and removed is not None and removed < LEAST_REMOVED:
        told = (
            f"the causes remove only {100.0 * removed:.0f} % of the squared missing force and moment: none is confident"
        )
        doubted = tuple(replace(f, confident=False) for f in found.findings)
        found = replace(found, verdict=Explanation.UNKNOWN, findings=doubted, warnings=(*found.warnings, told))
    physical = with_values(fit.vehicle, found.parameters, [c.effect for c in model.causes], model.theta)
    found = replace(found, vehicle=physical)
    result, (before, after) = found.to_dict(), found.validation.deciding
    result["validation"]["deciding"] = {
        "seconds": selection.shooting.seconds,
        "mse_nominal": before,
        "mse_extended": after,
    }
    result["warnings"] = [*result.get("warnings", []), *given.warnings]
    result["seed"] = seed
    advance("scores", 0.0)
    sets = []
    roles = ["train"] * len(train) + ["validate"] * len(held)
    for log, role in zip([*train, *held], roles, strict=True):
        then, now = (mse_score(log.windows, fit.vehicle, theta, fit.noise) for theta in models.values())
        sets.append(ScoredSet(log.recording.name, role, then, now))
    result["sets"] = [
        {"log": s.log, "role": s.role, "mse": {**square, "noise_floor": 1.0}}
        for s, square in zip(sets, squares, strict=True)
    ]
    result["missing"] = None if forces is None else forces.result()
    result["removed"] = removed
    # What each cause alone takes off.
    advance("gain of each cause", 0.0)
    for entry in result["findings"]:
        names = [n for c in model.causes if c.effect == entry["effect"] for n in c.names]
        taken = None if forces is None else forces.taken(Layout(fit.vehicle).without(model.theta, names), "extended")
        entry["gain"]["missing_removed"] = taken
    advance("random forces", 0.0)
    beside = None if forces is None else forces.beside(physical, terms=True)
    result["residual"] = None
    if beside is not None and beside.terms:
        result["residual"] = {"terms": [t.formula for t in beside.terms], "missing_removed": beside.removed}
        result["missing"]["statement"] += f" {beside.sentence}"
    if diagnose_verdict(result).level == "poor":  # what is left without a name may have bent the numbers too
        found = replace(found, parameters=unreliable(found.parameters, NOMINAL_NAMES))
        result["parameters"] = [parameter_entry(p) for p in found.parameters]
    return Diagnosed(result, sets, [*train, *held], forces, beside, found, fit.noise, described, selection)


def _within_reach(found: Diagnosis, unreachable: Mapping[str, str], off: Mapping[str, float]) -> Diagnosis:
    """The diagnosis without trust in what the channels of its logs cannot show, by parameter, and why.

    Intervals hold the truth if what is doubted of the logs is wrong and puts estimates `off`.
    """
    from quadid.identification.uncertainty import doubted

    trusted = [p.name for p in found.parameters if p.name in unreachable and p.status is not Status.PRIOR_DOMINATED]
    parameters, doubts = doubted(unreliable(found.parameters, trusted), off)
    told = [*doubts, *(f"{name} is not to be used: {unreachable[name]}" for name in trusted)]
    late = [
        f.effect for f in found.findings if EFFECTS[f.effect].needs_fast_rotors and set(INERTIAS) & set(unreachable)
    ]
    told += [f"{name} is not named with confidence: {unreachable[INERTIAS[0]]}" for name in dict.fromkeys(late)]
    findings = tuple(replace(f, confident=f.confident and f.effect not in late) for f in found.findings)
    return replace(found, findings=findings, parameters=parameters, warnings=(*found.warnings, *told))
