"""Flight logs: MCAP, MAVLink telemetry, DataFlash, ULog and CSV to recordings, and back."""

from quadid_replay.csv_writer import write_csv
from quadid_replay.mcap_writer import write_mcap
from quadid_replay.opening import open_log
from quadid_replay.tlog_writer import write_tlog
from quadid_replay.topic_writer import TopicWriter

__all__ = ["TopicWriter", "open_log", "write_csv", "write_mcap", "write_tlog"]
