"""Results become data that any JSON parser reads."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path

import numpy as np

from quadid.jsonable import jsonable


class Word(StrEnum):
    GOOD = "good"


def test_everything_that_results_hold_becomes_plain() -> None:
    value = {
        Word.GOOD: Word.GOOD,
        "path": Path("/a/b"),
        "row": np.array([1.0, np.nan, np.inf]),
        "number": np.float64(2.5),
        "whole": np.int32(7),
        "flag": np.bool_(True),
        "pair": (1, {"inner": float("-inf")}),
        3: None,
    }
    expected = {
        "good": "good", "path": "/a/b", "row": [1.0, None, None], "number": 2.5, "whole": 7, "flag": True,
        "pair": [1, {"inner": None}], "3": None,
    }  # fmt: skip
    assert jsonable(value) == expected
    assert json.loads(json.dumps(jsonable(value), allow_nan=False)) == expected
