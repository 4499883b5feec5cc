"""Flight logs: MCAP, MAVLink telemetry, DataFlash, ULog and CSV to recordings, and back.

The readers pull in large libraries; they are imported when first used, so that the command line starts quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadid_replay.compared_writer import write_compared
    from quadid_replay.csv_writer import write_csv
    from quadid_replay.mcap_writer import write_mcap
    from quadid_replay.opening import open_log
    from quadid_replay.tlog_writer import write_tlog
    from quadid_replay.topic_writer import TopicWriter

__all__ = ["TopicWriter", "open_log", "write_compared", "write_csv", "write_mcap", "write_tlog"]

_HOME = {
    "TopicWriter": "topic_writer",
    "open_log": "opening",
    "write_compared": "compared_writer",
    "write_csv": "csv_writer",
    "write_mcap": "mcap_writer",
    "write_tlog": "tlog_writer",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
