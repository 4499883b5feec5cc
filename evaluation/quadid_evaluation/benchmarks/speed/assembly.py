"""What the kernel's steps are made of: instructions in their machine code, counted.

All steps are one loop over lanes without branches, so the code is read off once per vector of lanes.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numba as nb

from quadid.model.body_kernel import step_air, step_full, step_solid
from quadid.model.kernel import step_core
from quadid.model.simd import whole

WIDEST = ("zmm", "ymm", "xmm")
_ARITHMETIC = re.compile(r"v(fn?m(add|sub)|add|sub|mul|min|max|rcp|rsqrt)")


def instructions() -> dict[str, Any]:
    """Compiles the steps afresh and counts; by step."""
    steps = {"nominal": step_core, "body alone": step_solid, "rotor drag": step_air, "full": step_full}
    return {"steps": {name: _counted(step) for name, step in steps.items()}}


def _counted(piece: Any) -> dict[str, Any]:
    step = nb.njit(**whole)(piece.py_func)
    step.compile((nb.float64, nb.float64[::1]))
    lines = [line.strip() for line in step.inspect_asm(step.signatures[0]).splitlines() if line.startswith("\t")]
    body = [line for line in lines if not line.startswith(".")]
    register = next((r for r in WIDEST if sum(r in line for line in body) > len(body) // 4), "none")
    wide = [line for line in body if register in line]
    names = Counter(line.split()[0] for line in wide)
    arithmetic = sum(n for name, n in names.items() if _ARITHMETIC.match(name))
    return {
        "register_bits": {"zmm": 512, "ymm": 256, "xmm": 128}.get(register, 0),
        "instructions": len(body),
        "wide": len(wide),
        "arithmetic": arithmetic,
        "fused": sum(n for name, n in names.items() if name.startswith(("vfm", "vfn"))),
        "moves": sum(n for name, n in names.items() if name.startswith("vmov")),
        "memory_operands": sum("(" in line for line in wide),
        "divisions_and_roots": sum(n for name, n in names.items() if name.startswith(("vdiv", "vsqrt"))),
    }
