"""Recorded flights of autopilots through the online session: estimates, alarms and waits."""
