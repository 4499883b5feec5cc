"""Flight logs: MCAP, MAVLink telemetry, DataFlash, ULog and CSV to recordings, and back.

The readers pull in large libraries; they are imported when first used, so that the command line starts quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadid_replay.opening import open_log
    from quadid_replay.writers import TopicWriter, write_compared, write_csv, write_mcap, write_tlog

__all__ = ["TopicWriter", "open_log", "write_compared", "write_csv", "write_mcap", "write_tlog"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{'opening' if name == 'open_log' else 'writers'}"), name)
