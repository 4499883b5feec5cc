"""Two services for one vehicle over DDS, each a process with a history of its own: one speaks, the other observes."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import Store
from quadid_node.publish import OBSERVES, YOUNG

from tests.faults.evidence import Happened
from tests.node.peers import Ear, node
from tests.online.test_gate import TRUE, online_set

pytestmark = pytest.mark.usefixtures("ros")


def history_with(path: Path, b: float, sequence: int) -> Path:
    """A history whose last set in force has this b."""
    store = Store(path, "pelican")
    store.numbered(replace(online_set({**TRUE, "b": b}), sequence=sequence, approved_by="auto"))
    store.close(30.0)
    return path


def b_of(message: Any) -> float:
    """Thrust coefficient of a set on the topic: each of the two histories has its own."""
    return float(dict(zip(message.names, message.values, strict=True))["b"])


def speakers(ear: Ear) -> set[tuple[int, ...]]:
    """Publishers of parameter sets, each by what DDS calls it."""
    return {tuple(found.endpoint_gid) for found in ear.node.get_publishers_info_by_topic("quadid/parameters")}


@pytest.mark.slow
def test_a_second_service_with_a_history_of_its_own_observes_and_takes_over(
    tmp_path: Path, ear: Ear, happened: Happened
) -> None:

    paths = [history_with(tmp_path / f"{k}.sqlite", b, 10 * k) for k, b in ((1, 2.3e-5), (2, 2.4e-5))]
    sets = ear.sets()
    with node(paths[0]) as first:
        first.wait_for("ready")
        assert ear.until(lambda: sets), first.text
        with node(paths[1]) as second:
            second.wait_for(OBSERVES)
            second.wait_for("ready")  # kernels compile for minutes on a busy machine
            ear.until(lambda: False, 3.0)
            assert {b_of(s) for s in sets} == {2.3e-5}, "the second one says nothing"
            assert first.end()[0] == 0
            begin = time.monotonic()
            assert ear.until(lambda: b_of(sets[-1]) == 2.4e-5), second.text
            took = time.monotonic() - begin
            assert second.end()[0] == 0
    happened(
        21, f"second node with a history of its own: observes with ERROR; first one ended: speaks {took:.1f} s later"
    )


@pytest.mark.slow
def test_two_that_lost_sight_of_each_other_end_with_one_speaker(tmp_path: Path, ear: Ear, happened: Happened) -> None:
    """The first one is stopped for so long that DDS takes it for gone; the second takes over; then both are there."""
    with node(tmp_path / "1.sqlite") as first:
        first.wait_for("ready")
        assert ear.until(lambda: len(speakers(ear)) == 1)
        with node(tmp_path / "2.sqlite") as second:
            second.wait_for(OBSERVES)
            second.wait_for("ready")
            begin, before = time.monotonic(), speakers(ear)
            first.child.send_signal(signal.SIGSTOP)
            assert ear.until(lambda: speakers(ear) - before and not speakers(ear) & before), second.text
            took_over = time.monotonic() - begin
            ear.until(lambda: False, YOUNG + 2.0)
            begin = time.monotonic()
            first.child.send_signal(signal.SIGCONT)
            both = ear.until(lambda: len(speakers(ear)) == 2)
            assert ear.until(lambda: len(speakers(ear)) == 1), f"{first.text}\n{second.text}"
            settled = time.monotonic() - begin
            ear.until(lambda: False, 8.0)
            assert len(speakers(ear)) == 1
            assert first.child.poll() is None
            assert second.child.poll() is None
    seen = "both spoke for a moment" if both else "it gave way before anyone saw both"
    happened(
        21, f"speaker stopped until DDS forgets it: the observer speaks after {took_over:.0f} s; the first one back "
        f"({seen}): one speaker again after {settled:.1f} s"
    )  # fmt: skip
