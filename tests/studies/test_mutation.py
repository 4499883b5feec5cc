"""Judgements of mutants: of functions that are there and that are spoilt."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]


def functions(source: str) -> set[str]:
    """Names of functions and methods as the judgements have them, without the underscores around them."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name.strip("_"))
        elif isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{f.name}".strip("_") for f in node.body if isinstance(f, ast.FunctionDef)}
    return found


def test_every_judgement_is_of_a_function_that_is_spoilt() -> None:
    judged = yaml.safe_load(
        (ROOT / "evaluation" / "quadid_evaluation" / "studies" / "mutation" / "judged.yaml").read_text(encoding="utf-8")
    )
    there: set[str] = set()
    for module in ("gate", "active_set", "session"):
        spec = importlib.util.find_spec(f"quadid.online.{module}")
        assert spec is not None
        assert spec.origin is not None
        there |= functions(Path(spec.origin).read_text(encoding="utf-8"))
    assert set(judged) <= there
