"""The documentation: its commands run, its equations become MathML, and it names nothing that is not there."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from quadid.cli.commands import COMMANDS, load
from tests.cli.followed_page import commands
from tests.commands import Cli


@pytest.mark.slow
def test_the_tutorial_runs_as_written(
    quadid: Cli, repository: Path, tmp_path: Path
) -> None:  # fmt: skip
    found = commands(repository / "docs" / "tutorial.md")
    assert len(found) == 10
    said = []
    for arguments in found:
        run = quadid(*arguments, cwd=tmp_path)
        assert run.code == 0, (arguments, run.err)
        said.append(run.out)
    amber, _, green, poor, good = said[4:9]
    assert "the simulation misses" in amber
    assert "All 6 parameters identified; nothing that counts is missing" in green
    assert "Not to be used" in poor
    assert "at the noise floor" in good
    page = (repository / "docs" / "tutorial.md").read_text(encoding="utf-8")
    printed = [" ".join(out.split()) for out in said]
    quoted = re.findall(r"^> (.+)$", page, re.MULTILINE)
    assert len(quoted) == 4
    for sentence in quoted:
        assert any(sentence in out for out in printed), sentence
    for file in ("report.html", "diagnosis.html", "pelican+weak_rotor+rotor_drag.yaml"):
        assert (tmp_path / file).is_file()


def test_every_command_that_a_page_names_exists(repository: Path) -> None:
    for page in (repository / "docs").rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`quadid ([a-z]+)\b", text):
            assert name in COMMANDS, (page.name, name)
        for example in re.findall(r"`(examples/[\w./]+)`", text):
            assert (repository / example).exists(), (page.name, example)
        for module in re.findall(r"`python -m ([\w.]+)", text):
            assert importlib.util.find_spec(module) is not None, (page.name, module)


def test_every_option_that_a_page_or_a_help_text_quotes_is_known(repository: Path) -> None:
    pages = [repository / "README.md", repository / "SECURITY.md", *(repository / "docs").rglob("*.md")]
    lines = [(page.name, line) for page in pages for line in commands(page)]
    lines += [("--help", shlex.split(line)[1:]) for command in COMMANDS.values() for line in command.examples]
    assert len(lines) > 60
    for where, (name, *arguments) in lines:
        # Parsed as when called: options, their values, and what must be given.
        assert load(name).make_context(name, list(arguments)), (where, name, arguments)


def test_every_option_quoted_in_a_sentence_is_known(repository: Path) -> None:
    for page in [repository / "README.md", *(repository / "docs").rglob("*.md")]:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        for name, rest in re.findall(r"`quadid ([a-z]+)\b([^`]*)`", text):
            known = {option for parameter in load(name).params for option in parameter.opts}
            for option in re.findall(r"(?<!\S)--[a-z-]+", rest):
                assert option in known, (page.name, name, option)


def test_every_test_that_a_wish_names_exists(repository: Path) -> None:
    text = (repository / "docs" / "results" / "wishes.md").read_text(encoding="utf-8")
    named = re.findall(r"`(tests/[\w./]+)`", text)
    assert len(named) >= 12
    for name in named:
        assert (repository / name).exists(), name


def test_equations_become_mathml_and_code_is_left_alone(repository: Path) -> None:
    pytest.importorskip("latex2mathml", reason="pip install .[docs]")
    spec = importlib.util.spec_from_file_location("docs_math", repository / "tools" / "docs_math.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = module.on_page_markdown("a $x^2$ b `$HOME and $PATH`\n\n$$ y = 1 $$\n\n```\n$$ z $$\n```\n")
    assert page.count("<math") == 2
    assert "\n<math" not in module.on_page_markdown("in the text\n$x^2$ begins a line")
    assert "`$HOME and $PATH`" in page
    assert "$$ z $$" in page
