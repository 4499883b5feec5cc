"""Every input on which the product failed once is answered rightly."""

from __future__ import annotations

from pathlib import Path

import pytest
from quadid_evaluation.studies.findings import FINDINGS, Finding, judged


@pytest.mark.parametrize("finding", FINDINGS, ids=lambda f: f"{f.folder}: {f.what}")
def test_each_finding_is_answered_rightly(finding: Finding, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    right, line, numbers = judged(finding, data_dir)
    assert right, (line, numbers)
