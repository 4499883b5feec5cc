"""Flight logs: MCAP, MAVLink telemetry, DataFlash, ULog and CSV to samples, and back."""
