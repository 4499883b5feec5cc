"""Pages that commands write: what people judged outlives the next run, and nothing is counted that was not there."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from quadid_evaluation.benchmarks.online import flown
from quadid_evaluation.harness import judged
from quadid_evaluation.studies import coverage
from quadid_evaluation.studies.soak import BATCH, batches


def test_what_people_judged_outlives_the_next_run(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    assert judged(page) == ""
    page.write_text("# Title\n\n1 %\n\n## Judged by hand\n\n* It is enough.\n")
    page.write_text("# Title\n\n2 %\n" + judged(page))
    assert page.read_text() == "# Title\n\n2 %\n\n## Judged by hand\n\n* It is enough.\n"


def test_compiled_functions_are_counted_apart(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("@nb.njit(**jit)\ndef f(x):\n    y = x\n    return y\n\n\ndef g():\n    return 1\n")
    assert coverage.compiled(tmp_path) == 2


def test_coverage_is_told_by_room() -> None:
    files = {
        "quadid/data/window.py": Counter(statements=90, run=90, branches=10, taken=0),
        "quadid/online/gate.py": Counter(statements=10, run=5, branches=10, taken=5),
    }
    text = coverage.page(files, 7)
    assert "**83.3 % of statements and branches**" in text
    assert "| `quadid/online` | 5/10 | 5/10 | **50.0 %** |" in text


def test_batches_hold_every_sample_once_and_no_channel_runs_ahead() -> None:
    recording = flown(3.0, 3).recording
    made = batches(recording)
    told = Counter((name, t) for batch in made for b in batch for name, _ in b.columns for t in b.t.tolist())
    assert told == Counter((name, t) for name, c in recording.channels.items() for t in c.t.tolist())
    for batch in made:
        assert max(b.t[-1] for b in batch) - min(b.t[0] for b in batch) <= BATCH
