"""Causes by innovations: the selection of a diagnosis in which random forces belong to the model.

One likelihood decides (`models`): every model is at its maximum, random forces and all noise with it.  A linearisation
of everything predicts what each move brings (`evidence`), moves are refitted and compared (`search`), and what remains
is judged by the random forces that still act and by what the innovations follow (`remainder`).

On simulated flights it names what `quadid.diagnosis` names, and more in rough air; on recorded ones it names too much
and takes minutes, so the product does not use it yet (`docs/results/innovations.md`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

from quadid.blas import one_thread
from quadid.data.window import Window, without_copies
from quadid.diagnosis.evidence import impossible_causes, slight_causes
from quadid.diagnosis.hypotheses import candidates
from quadid.diagnosis.residual_tests import inconstant_causes
from quadid.diagnosis.result import Explanation
from quadid.model.layout import Layout, with_reference_voltage
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.innovations.models import Flights
from quadid_evaluation.studies.innovations.remainder import Remainder, judge, remainder
from quadid_evaluation.studies.innovations.search import Search, select


class Answer(NamedTuple):
    """Verdict, effects named with confidence, effects listed beside them and why, and what led there."""

    verdict: Explanation
    named: tuple[str, ...]
    doubted: Mapping[str, str]
    search: Search
    left: Remainder


def searched(windows: Sequence[Window], vehicle: Vehicle) -> Search:
    """The causes that flights support, from the guess of the vehicle file."""
    windows = without_copies(windows)
    vehicle = with_reference_voltage(vehicle, windows)
    rotors = ["readings" if vehicle.command.sampling == "instant" else "commands"]
    if vehicle.reference_voltage is not None and all(w.battery is not None for w in windows):
        rotors.append("battery")
    velocity, position = (all(getattr(w, n) is not None for w in windows) for n in ("velocity", "position"))
    listed = [c for c in candidates(Layout(vehicle), velocity, position, rotors) if c.effect not in vehicle.effects]
    flights, nominal = Flights.of(windows, vehicle, listed).nominal(Layout(vehicle).initial(vehicle))
    return select(flights, nominal)


@one_thread()
def diagnosed(windows: Sequence[Window], vehicle: Vehicle) -> Answer:
    """The answer to flights from the vehicle file's guess."""
    search = searched(windows, vehicle)
    model, left = search.model, remainder(search.flights, search.model)
    alike = cast(Any, model)  # what the product asks of a model, this one has too
    doubts = impossible_causes(alike) | inconstant_causes(alike, cast(Any, left)) | slight_causes(alike)
    verdict = judge(search.nominal, model, left)
    if verdict is Explanation.UNKNOWN:
        doubts = {c.label: doubts.get(c.label, "something else remains") for c in model.causes}
    named = tuple(dict.fromkeys(c.effect for c in model.causes if c.label not in doubts))
    return Answer(verdict, named, doubts, search, left)
