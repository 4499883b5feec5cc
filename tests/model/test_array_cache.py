"""Arrays that are kept: the most recent ones, and never more bytes than allowed."""

from __future__ import annotations

import numpy as np

from quadid.model.rollout import ArrayCache


def test_the_least_recently_used_goes_first() -> None:
    kept = ArrayCache(3 * 80)
    for key in "abc":
        kept.keep(key, np.full(10, float(ord(key))))
    assert kept.get("a") is not None
    kept.keep("d", np.zeros(10))
    assert kept.get("b") is None
    assert all(kept.get(key) is not None for key in "acd")


def test_what_is_larger_than_allowed_is_not_kept_and_a_key_counts_once() -> None:
    kept = ArrayCache(100)
    kept.keep("large", np.zeros(20))
    assert kept.get("large") is None
    for _ in range(5):
        kept.keep("small", np.zeros(10))
    assert kept.get("small") is not None
    kept.keep("other", np.zeros(2))
    assert kept.get("small") is not None
