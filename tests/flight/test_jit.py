"""Machine code on disk is dropped when any source of the room changes, not only the kernel's own file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, cast

import quadid.attitude_controller
import quadid.flight
from quadid.flight import jit
from quadid.flight.airframe import derivative
from quadid.flight.march import march
from quadid.vehicle import GRAVITY


def test_stamp_of_every_kernel_covers_all_sources() -> None:
    digest = hashlib.sha256(repr(GRAVITY).encode())
    digest.update(Path(quadid.attitude_controller.__file__).read_bytes())
    for file in sorted(Path(quadid.flight.__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    assert jit.fingerprint() == digest.hexdigest()
    for kernel in (march, derivative):
        # numba's own names: a numba that renames them must fail here and not fly stale physics
        index = cast(Any, kernel)._cache._cache_file
        assert str(index._source_stamp).endswith(jit.fingerprint())
        assert index._load_index() == {} or index._source_stamp
