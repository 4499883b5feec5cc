"""Size of the diagnosis: files, lines, named numbers, layers of imports."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import quadid.diagnosis
from quadid_evaluation.studies.house import named_numbers

ROOM = "quadid.diagnosis."


@dataclass(frozen=True)
class House:
    """Sizes of the room.

    Attributes:
        files, lines: of its modules, the package's own file among them.
        numbers: names of its constants that are numbers, tuples of numbers or worked out from such.
        layers: its modules, those that import none of the others first.
    """

    files: int
    lines: int
    numbers: tuple[str, ...]
    layers: tuple[tuple[str, ...], ...]

    def __str__(self) -> str:
        """One line for each wanted figure."""
        rows = (
            f"files {self.files} (wanted 16)", f"lines {self.lines} (2300)",
            f"named numbers {len(self.numbers)} (30): {', '.join(self.numbers)}", f"layers {len(self.layers)} (7)",
        )  # fmt: skip
        return "\n".join([*rows, *(f"  {i}: {', '.join(layer)}" for i, layer in enumerate(self.layers))])


def measured() -> House:
    """The room as it stands on disk."""
    paths = sorted(Path(next(iter(quadid.diagnosis.__path__))).glob("*.py"))
    trees = {p.stem: ast.parse(p.read_text(encoding="utf-8")) for p in paths}
    lines = sum(len(p.read_text(encoding="utf-8").splitlines()) for p in paths)
    return House(len(paths), lines, tuple(n for t in trees.values() for n in named_numbers(t)), _layers(trees))


def _layers(trees: dict[str, ast.Module]) -> tuple[tuple[str, ...], ...]:
    """Modules by the length of the longest chain of imports below them; the package's own file only passes names on."""
    below = {name: _imported(tree) for name, tree in trees.items() if name != "__init__"}

    @cache
    def height(name: str) -> int:
        return 1 + max((height(n) for n in below[name]), default=-1)

    top = max(height(n) for n in below)
    return tuple(tuple(n for n in below if height(n) == level) for level in range(top + 1))


def _imported(tree: ast.Module) -> list[str]:
    names = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module]
    return sorted({n.removeprefix(ROOM) for n in names if n.startswith(ROOM)})
