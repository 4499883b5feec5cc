"""Sets that would destabilise a controller: refused with the reason in the history, at once or in small steps.

Session, gate, ledger, service and SQLite are real; what the fits say is made up (`tests.online.test_gate_machine`).
"""

import math
from collections.abc import Iterator

import pytest
from quadid_node.history import read_history

from quadid.online import SetState
from quadid.parameters import NOMINAL_NAMES
from tests.faults.evidence import Happened
from tests.online.test_gate_machine import Machine


@pytest.fixture
def machine() -> Iterator[Machine]:
    made = Machine()
    made.start("auto")
    assert made.published, "a first set is in force"
    yield made
    made.teardown()


def reasons(machine: Machine) -> list[tuple[str, str]]:
    machine.store.close(60.0)
    found = read_history(machine.path, "pelican", candidates=10_000)["candidates"]
    return [(c["check"], c["reason"]) for c in found if c["state"] == "rejected"]


@pytest.mark.parametrize(
    ("factors", "word"),
    [
        (dict.fromkeys(("J_xx", "J_yy", "J_zz"), 4.0), "J_xx"),
        ({"b": 2.0}, "b would give"),
        ({"b": -1.0}, ""),
        ({"J_xx": 4.0}, "J_xx"),
    ],
    ids=["inertia times 4", "b times 2", "sign of b", "one inertia times 4"],
)
def test_a_destabilising_vehicle_is_never_published(
    machine: Machine, factors: dict[str, float], word: str, happened: Happened
) -> None:
    before, force = len(machine.published), machine.ledger.in_force
    machine.factors = {n: factors.get(n, 1.0) for n in NOMINAL_NAMES}
    for _ in range(4):
        machine.fly(12.0)
    told = reasons(machine)
    later = machine.published[before:]
    assert all(s.outdated for s in later), "that the set in force is out of date is all that may be published"
    assert force is not None
    assert machine.ledger.in_force is not None
    for item in (*later, machine.ledger.in_force):
        assert item.parameters.values.tobytes() == force.parameters.values.tobytes()
    if word:
        assert any(word in reason for _, reason in told), told[-5:]
    what = ", ".join(f"{n} × {f:g}" for n, f in factors.items())
    last = f"{told[-1][0]}: {told[-1][1]}" if word and told else "no estimate is made of it"
    happened(17, f"{what}, told by every fit for 48 s: nothing published; in the history '{last[:110]}'")


@pytest.mark.parametrize("name", ["b", "J_xx"])
def test_creeping_there_in_small_steps_ends_at_the_baseline_even_across_restarts(
    machine: Machine, name: str, happened: Happened
) -> None:
    start = machine.published[0].parameters[name].value
    factor, steps = 1.0, 0
    while factor < 2.0:
        factor, steps = factor * 1.06, steps + 1
        machine.factors[name] = factor
        machine.fly(8.0)
        if steps % 4 == 0:
            machine.restart()
    reached = max(s.parameters[name].value for s in machine.published if s.state is SetState.ACCEPTED) / start - 1.0
    told = reasons(machine)
    first = machine.published[0]
    sigma = math.hypot(*(first.told_by_flight(n) / first.parameters[n].value for n in ("b", "J_xx")))
    limit = math.exp(math.log1p(machine.settings.gate.reference) + 2.0 * sigma) - 1.0
    assert reached <= limit + 1e-9, "the limit, and two standard deviations of the first set"
    assert told
    happened(
        17,
        f"{name} creeping to × 2 by 6 % a step with restarts between: published up to {reached:+.0%} of the "
        f"baseline, then '{told[-1][0]}: {told[-1][1][:80]}'",
    )
