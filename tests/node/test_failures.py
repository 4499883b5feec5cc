"""A job that fails by an error of the program: its input is kept beside the history, and can be done again."""

from pathlib import Path

import numpy as np
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


def test_a_link_beside_the_history_has_no_file_of_another_folder_removed(tmp_path: Path, happened: Happened) -> None:
    """The oldest of what is kept is removed: in the folder of the user that a link of that name leads to, too."""
    history, mine = tmp_path / "h.sqlite", tmp_path / "mine"
    mine.mkdir()
    names = [f"{i}.job" for i in range(MOST + 2)]
    for name in names:
        (mine / name).touch()
    folder_of(history).symlink_to(mine)
    request = FitRequest(1, PELICAN, (), 0.0, 1.0, np.ones(3), np.ones(3), None, 0, ())
    assert "could not be kept" in keep(history, request)
    assert sorted(path.name for path in mine.iterdir()) == sorted(names)
    happened(11, "a link where inputs of failed jobs are kept: refused, the files it leads to are there")


def test_files_that_claim_to_be_newer_do_not_have_an_input_removed(tmp_path: Path) -> None:
    history = tmp_path / "h.sqlite"
    folder_of(history).mkdir()
    for i in range(MOST):
        (folder_of(history) / f"~{i}.job").mkdir()
    request = FitRequest(1, PELICAN, (), 0.0, 1.0, np.ones(3), np.ones(3), None, 0, ())
    assert isinstance(repeat(Path(keep(history, request).removeprefix("its input is in "))), FitReply)


def test_a_file_that_holds_no_job_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.job").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(ParcelError):
        repeat(tmp_path / "x.job")
