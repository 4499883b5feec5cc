"""Every input on which the product failed once is answered rightly."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from quadid_evaluation.studies import findings

from tests.commands import Cli


@pytest.mark.parametrize("finding", findings.FINDINGS, ids=lambda f: f"{f.folder}: {f.what}")
def test_each_finding_is_answered_rightly(
    finding: findings.Finding, data_dir: Path, inside: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer_of(arguments: Sequence[str | Path]) -> findings.Answer:
        result = tmp_path / f"{arguments[0]}.json"
        run = inside(*arguments, *([] if arguments[0] == "init" else ["--json", result]))
        data = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
        return run.code, f"{run.err}{run.out}", data

    monkeypatch.setattr(findings, "answer_of", answer_of)
    right, line, numbers = findings.judged(finding, data_dir)
    assert right, (line, numbers)


@pytest.mark.slow
@pytest.mark.parametrize("attack", findings.ATTACKS, ids=lambda f: f"{f.folder}: {f.what}")
def test_each_attack_is_answered_rightly(attack: findings.Finding, data_dir: Path) -> None:
    right, line, numbers = findings.judged(attack, data_dir)
    assert right, (line, numbers)
