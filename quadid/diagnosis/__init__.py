"""Diagnosis: what the simulation gets wrong, why, and what the better model gains."""

from quadid.diagnosis.pipeline import diagnose as diagnose
from quadid.diagnosis.result import Diagnosis as Diagnosis
from quadid.diagnosis.search import Search as Search
