"""Conversion of single messages: the numbers of the log readers, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from quadid_node.convert import _FAST
from quadid_replay.mcap_messages import SIGNALS

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)
WIDTH = {"attitude": 4, "pose_attitude": 4, "frd_attitude": 4, "battery": 1}


@pytest.mark.parametrize("name", sorted(_FAST))
@given(data=st.data())
def test_the_fast_way_gives_the_same_bits(name: str, data: st.DataObject) -> None:
    width = WIDTH.get(name, 3)
    values = tuple(data.draw(st.lists(NUMBERS, min_size=width, max_size=width)))
    _, convert = SIGNALS[name]
    slow = convert(np.array([values]))[0]
    assert np.array_equal(_FAST[name](values), slow)
