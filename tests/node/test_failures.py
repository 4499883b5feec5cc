"""A job that fails by an error of the program: its input is kept beside the history, and can be done again."""

from __future__ import annotations

from pathlib import Path

import pytest
from quadid_node.history import Store
from quadid_node.service import Service
from quadid_node.wire_format import MOST, ParcelError, folder_of, keep, repeat
from quadid_node.worker import InlineWorker, Trouble

from quadid.online import FitReply, FitRequest
from quadid.online.grid_buffer import WindowCut
from quadid.online.records import JobReply
from tests.faults.evidence import Happened
from tests.online.made_up import PELICAN, QUICK, light_flight


class Failing(InlineWorker):
    """Every fit fails as one with a mistake in its program does."""

    def poll(self) -> list[JobReply | Trouble]:
        """Fails at all that waits."""

        class Broken(FitRequest):
            def answer(self) -> FitReply:
                raise IndexError("index 12 is out of bounds")

        waiting, self._waiting = self._waiting, []
        return [Broken(**vars(job)).run() if isinstance(job, FitRequest) else job.run() for job in waiting]


def test_the_input_of_an_unexpected_error_is_kept_for_replay(tmp_path: Path, happened: Happened) -> None:
    store = Store(tmp_path / "h.sqlite", "pelican")
    service, told = Service(PELICAN, QUICK, Failing(), store), []
    for sample in light_flight(20.0):
        service.push(sample.block)
        told += [o.text for o in service.step() if o.topic == "event" and o.level == "error"]
    kept = sorted(folder_of(store.path).iterdir())
    assert kept
    assert any(str(kept[0]) in text and "IndexError" in text for text in told)
    reply = repeat(kept[0])
    assert isinstance(reply, FitReply)
    assert not reply.is_unexpected
    size = kept[0].stat().st_size
    request = service.session.running or service.session._estimator.request(1, WindowCut((), 1.0, 0), 0.0, 1.0)
    for _ in range(3 * MOST):
        assert "its input is in" in keep(store.path, request)
    assert len(list(folder_of(store.path).iterdir())) <= MOST
    store.close()
    happened(11, f"a fit with an error of the program: told, its input kept ({size} bytes), done again")


def test_a_file_that_holds_no_job_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.job").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(ParcelError):
        repeat(tmp_path / "x.job")
