"""The missing force and moment of identified and diagnosed flights: for JSON, as a sentence, over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.app.logs import Log, free_name, written_whole
from quadid.app.over_time import OverTime
from quadid.blas import one_thread
from quadid.data.window import CHANNEL_NAMES, Channel, Recording, Window, beginning
from quadid.errors import ParameterError
from quadid.model.layout import Layout
from quadid.report.verdict import percent
from quadid.types import FloatArray, JsonDict
from quadid.vehicle import RandomForces, ResidualTerm, Vehicle

if TYPE_CHECKING:
    from quadid.estimate.missing import Missing, Vehicles

SECONDS, ROWS = 120.0, 12000
"""Of every log, its first so many seconds are looked at [s], and no more rows: a filter keeps 4 kB of each."""
AXES = ("x", "y", "z")


def recorded(name: str, t: FloatArray, values: Mapping[str, FloatArray], source: str) -> Recording:
    """Rows of channels as a recording; those that were not measured, or ran away, are left out."""
    known = {channel: np.isfinite(rows).all(axis=1) for channel, rows in values.items()}
    channels = {c: Channel(c, t[here], values[c][here], source) for c, here in known.items() if here.any()}
    return Recording(name, "series", channels)


@dataclass(frozen=True)
class MissingForces:
    """Missing force and moment of models on every log.

    Attributes:
        models: parameter vectors by name, ``nominal`` first.
        logs: the logs, training logs first.
        roles: ``train`` or ``validate`` of each.
        parts: by model, the stretches of every log.
        flights: the noise at which models are compared.
        extends: the last model has effects that the first one lacks.
    """

    models: tuple[str, ...]
    logs: Sequence[Log]
    roles: Sequence[str]
    parts: Mapping[str, Sequence[Sequence[Missing]]]
    flights: Vehicles
    flown: Sequence[Sequence[Window]]
    extends: bool

    def result(self) -> dict[str, Any]:
        """The entry ``missing`` of contract §7; what all training logs miss first."""
        train = [i for i, role in enumerate(self.roles) if role == "train"]
        return {
            **self._entry(train),
            "statement": self.statement(),
            "sets": [
                {"log": log.recording.name, "role": role, **self._entry([i])}
                for i, (log, role) in enumerate(zip(self.logs, self.roles, strict=True))
            ],
        }

    def _entry(self, which: Sequence[int]) -> dict[str, Any]:
        from quadid.estimate.missing import control_size, size

        force: dict[str, Any] = {"unit": "N"}
        moment: dict[str, Any] = {"unit": "N m"}
        for model in self.models:
            for entry, is_force in ((force, True), (moment, False)):
                found, interval = size(self._stretches(model, which), is_force)
                entry[model] = _by_axis(found)
                entry[f"{model}_ci95"] = dict(zip(AXES, interval.T.tolist(), strict=True))
        first = self._stretches(self.models[0], which)
        force |= {"of": first[0].weight, "of_what": "weight"}
        moment |= {"of": _by_axis(control_size(first)), "of_what": "rms control moment"}
        return {"force": force, "moment": moment}

    def _stretches(self, model: str, which: Sequence[int] | None = None) -> list[Missing]:
        """Stretches of these logs as a model sees them; of those that judge by default."""
        return [part for i in (self.deciding if which is None else which) for part in self.parts[model][i]]

    @property
    def deciding(self) -> list[int]:
        """Places of the logs that judge the models: those that were not fitted, else all."""
        return [i for i, role in enumerate(self.roles) if role == "validate"] or list(range(len(self.logs)))

    def statement(self) -> str:
        """One sentence: what the models miss on the deciding logs, as shares of weight and of control moment."""
        from quadid.estimate.missing import control_size, size

        each = []
        for model in self.models:
            parts = self._stretches(model)
            force, moment = (size(parts, is_force)[0] for is_force in (True, False))
            total, weight = float(np.linalg.norm(force)), parts[0].weight
            shares = ", ".join(percent(share).removesuffix(" %") for share in moment / control_size(parts))
            each.append((f"{total:.2g} N ({percent(total / weight)} of the weight)", f"{shares} %"))
        (force_then, moment_then), (force_now, moment_now) = each[0], each[-1]
        unseen = "validation flights" if "validate" in self.roles else "these flights"
        missed = f"the simulation misses {force_then} and {moment_then} of the rms roll, pitch and yaw moment"
        found = f"; with what was found {force_now} and {moment_now}" if self.extends else ""
        return f"On {unseen} {missed} of the rotors{found}."

    def section(self) -> JsonDict:
        """Part of a page: what is missing on the last deciding log over time, and its size by axis on all of them."""
        from quadid.report.fit_pages import missing_section

        shown = self.deciding[-1]
        parts = {model: self.parts[model][shown] for model in self.models}
        return missing_section(self._entry(self.deciding), self.logs[shown].recording.name, parts)

    def beside(self, vehicle: Vehicle, terms: bool) -> Beside:
        """Forces beside the values of a vehicle file: terms beyond the catalogue, and what remains, at random.

        Terms are kept where they take a part of what is missing off flights that were not fitted.

        Args:
            terms: whether they are looked for.
        """
        from quadid.estimate.missing import random_forces, removed
        from quadid.estimate.residual import LEAST, learn

        def seen(vehicle: Vehicle) -> list[list[Missing]]:
            theta = Layout(vehicle).initial(vehicle)
            return [self.flights.missing(windows, theta, vehicle) for windows in self.flown]

        def of(found: Sequence[Sequence[Missing]], role: str) -> list[Missing]:
            return [part for parts, own in zip(found, self.roles, strict=True) if own == role for part in parts]

        before = seen(vehicle)
        if not _finite(before):
            return Beside((), None, None)
        flown = all(w.velocity is not None for windows in self.flown for w in windows)
        others = [parts for parts, own in zip(before, self.roles, strict=True) if own == "validate"]
        found = learn(of(before, "train"), others, flown) if terms else ()
        if found:
            after = seen(vehicle.model_copy(update={"residual": (*vehicle.residual, *found)}))
            judge = "validate" if "validate" in self.roles else "train"
            share = removed(of(before, judge), of(after, judge)) if _finite(after) else 0.0
            if share >= LEAST:
                return Beside(found, share, random_forces(of(after, "train")))
        return Beside((), None, random_forces(of(before, "train")))

    def taken(self, before: str | FloatArray, after: str | FloatArray) -> float:
        """Share of the squared missing force and moment of one model that another takes away.

        Args:
            before, after: names of models, or parameter vectors; compared on logs that were not fitted, else on all.
        """
        from quadid.estimate.missing import removed

        return removed(
            *(
                self._stretches(model)
                if isinstance(model, str)
                else [part for i in self.deciding for part in self.flights.missing(self.flown[i], model)]
                for model in (before, after)
            )
        )

    def over_time(self, i: int, model: str | None = None) -> OverTime:
        """Missing force [N] and moment [N m] of log `i`, innovations, and the sigma of each; of the last model else.

        Raises:
            ParameterError: an unknown model.
        """
        if model not in (None, *self.models):
            raise ParameterError(f"unknown model '{model}'", ", ".join(self.models))
        chosen = model or self.models[-1]
        sizes = {"force": ("axis", AXES), "moment": ("axis", AXES), "innovation": ("output", CHANNEL_NAMES[:12])}
        labels = {part: of for name, of in sizes.items() for part in (name, f"{name}_sigma")}
        values = {part: self._joined(i, chosen, part) for part in labels}
        return OverTime(self._joined(i, chosen, "t"), values, labels)

    def save(self, folder: str | Path = ".") -> list[Path]:
        """Writes ``LOG.missing.csv`` for every log: force [N], moment [N m], innovations of every model, with sigma."""
        out: list[Path] = []
        for i, log in enumerate(self.logs):
            found = {model: self.over_time(i, model) for model in self.models}
            columns = ["t", *(f"{model}/{column}" for model, one in found.items() for column in one.columns)]
            table = [self._joined(i, self.models[0], "t")[:, None], *(one.table for one in found.values())]
            path = free_name(folder, log.name, "missing.csv", out)
            with written_whole(path) as part:
                np.savetxt(part, np.concatenate(table, axis=1), "%.8g", ",", header=",".join(columns), comments="")
            out.append(path)
        return out

    def wrenches(self, i: int) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Missing force and moment of log `i`, and their sigma, by topic: times, shape (n,), and rows of six."""
        t = self._joined(i, self.models[0], "t")
        return {
            f"missing/{model}{'/sigma' * bool(end)}": (
                t,
                np.hstack([self._joined(i, model, f"force{end}"), self._joined(i, model, f"moment{end}")]),
            )
            for model in self.models
            for end in ("", "_sigma")
        }

    def innovations(self, i: int) -> dict[str, Recording]:
        """Innovations of gyro and accelerometer of log `i` by model."""
        from quadid.estimate.kalman import ACCEL, GYRO

        t, out = self._joined(i, self.models[0], "t"), {}
        for model in self.models:
            values = self._joined(i, model, "innovation")
            three = {name: values[:, at : at + 3] for name, at in (("gyro", GYRO), ("accel", ACCEL))}
            out[f"innovation/{model}"] = recorded(self.logs[i].name, t, three, "innovation")
        return out

    def _joined(self, i: int, model: str, name: str) -> FloatArray:
        """One field of all stretches of log `i`, one after the other."""
        return np.concatenate([getattr(part, name) for part in self.parts[model][i]])


@dataclass(frozen=True)
class Beside:
    """Forces that act beside the values of a vehicle file.

    Attributes:
        removed: share of the squared missing force and moment that they take off unseen flights, off the training
            flights where there are no others; None without terms.
        random: what remains, at random; None where no finite answer is found.
    """

    terms: tuple[ResidualTerm, ...]
    removed: float | None
    random: RandomForces | None

    @property
    def sentence(self) -> str:
        """Worth of the terms."""
        return (
            f"Terms beyond the catalogue take {100.0 * (self.removed or 0.0):.2g} % off its squares: "
            f"{'; '.join(t.formula for t in self.terms)}."
        )

    def in_vehicle(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle with it; what was not found stays as it is."""
        told = {"residual": (*vehicle.residual, *self.terms), "random": self.random or vehicle.random}
        return vehicle.model_copy(update=told)


def _finite(found: Sequence[Sequence[Missing]]) -> bool:
    return all(np.isfinite(p.force_sigma).all() and np.isfinite(p.sizes).all() for parts in found for p in parts)


def _by_axis(values: FloatArray) -> dict[str, float]:
    return {axis: float(v) for axis, v in zip(AXES, values, strict=True)}


@one_thread()
def compared(
    train: Sequence[Log],
    held: Sequence[Log],
    vehicle: Vehicle,
    models: Mapping[str, FloatArray],
    guesses: Mapping[str, FloatArray],
    advance: Callable[[str, float], None],
) -> tuple[MissingForces | None, list[dict[str, float]]]:
    """Missing force and moment of parameter vectors, and how right each is about its own errors on every log.

    All are judged at the noise of the first on the training logs.  No force and moment is seen where a log lacks the
    gyro or the accelerometer, or a model has no finite answer.

    Args:
        models: parameter vectors by name, the nominal one first.
        guesses: vectors by name of which only errors are asked.

    Returns:
        Missing force and moment; by log, training logs first, the mean square of whitened innovations of every vector.
    """
    from quadid.estimate.missing import Vehicles

    logs, roles = [*train, *held], ["train"] * len(train) + ["validate"] * len(held)
    flown = [beginning(log.windows, min(SECONDS, ROWS * log.windows[0].dt))[0] for log in logs]
    visible = all(windows and all(_seen(w) for w in windows) for windows in flown)
    stage, steps = "what is missing", 1 + len(models) * len(flown)
    advance(stage, 0.0)
    # The noise of the first model decides; then every model on every log, trim and biases of the log fitted.
    first, *_, last = models.values() if len(models) > 1 else [next(iter(models.values()))] * 2
    flights = Vehicles([w for windows in flown[: len(train)] for w in windows], vehicle, first)
    squares = [{name: flights.mean_square(windows, theta) for name, theta in guesses.items()} for windows in flown]
    parts: dict[str, list[list[Missing]]] = {name: [] for name in models}
    for done, (name, i) in enumerate(((n, i) for n in models for i in range(len(flown))), 1):
        advance(stage, done / steps)
        if visible:
            found, squares[i][name] = flights.both(flown[i], models[name])
            parts[name].append(found)
        else:
            squares[i][name] = flights.mean_square(flown[i], models[name])
    if not visible or not all(_finite(found) for found in parts.values()):
        return None, squares
    extends = not np.array_equal(first[6:], last[6:])
    return MissingForces(tuple(models), logs, roles, parts, flights, flown, extends), squares


def _seen(window: Window) -> bool:
    return all(v is not None and np.isfinite(v).all(axis=1).any() for v in (window.gyro, window.accel))
