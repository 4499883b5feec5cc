"""Flight logs: MCAP, MAVLink telemetry, DataFlash, ULog and CSV to recordings, and back."""

from quadid_replay.opening import open_log

__all__ = ["open_log"]
