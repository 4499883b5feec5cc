"""The pages about effects and method keep up with the code."""

import re
from pathlib import Path

import pytest

from quadid.diagnosis.evidence import FALSE_ALARM
from quadid.diagnosis.hypotheses import BLOCKS, RELEVANT
from quadid.diagnosis.pipeline import SHARE_TO_NAME
from quadid.effects import EFFECTS


def test_every_effect_has_its_part_and_no_other_is_explained(repository: Path) -> None:
    page = (repository / "docs" / "effects.md").read_text(encoding="utf-8")
    parts = re.split(r"^### ", page, flags=re.MULTILINE)[1:]
    explained = {re.split(r"\s", part)[0]: part for part in parts}
    assert set(explained) == set(EFFECTS)
    assert len(parts) == len(EFFECTS)
    for name, part in explained.items():
        for word in ("**Equation:**", "**Size:**", "**Signs:**", "**Similar:**", "**Separated by:**"):
            assert word in part, (name, word)
        assert EFFECTS[name].advice.endswith("."), f"{name}: what to do is said with the finding"
        assert ("(of the flight)" in part.splitlines()[0]) == EFFECTS[name].per_log, name


@pytest.mark.parametrize(
    "words",
    [
        f"{100 * RELEVANT:.1f} % of the independent residuals",
        f"{FALSE_ALARM} divided by",
        f"{BLOCKS} blocks of time",
        f"at least {100 * SHARE_TO_NAME:.0f} % of all structure",
    ],
)
def test_the_page_of_the_method_states_the_rule_that_is_in_force(words: str, repository: Path) -> None:
    page = (repository / "docs" / "diagnosis-method.md").read_text(encoding="utf-8")
    assert words in " ".join(page.split())


def test_tests_that_the_review_points_to_exist(repository: Path) -> None:
    page = (repository / "docs" / "diagnosis-method.md").read_text(encoding="utf-8")
    code = "".join(p.read_text(encoding="utf-8") for p in (repository / "tests" / "diagnose").glob("*.py"))
    named = [n.rstrip("…") for n in re.findall(r"`(test_\w+…?)`", page) if not n.endswith("_py")]
    assert named
    for name in named:
        assert f"def {name}" in code or (repository / "tests" / "diagnose" / f"{name}.py").is_file(), name
