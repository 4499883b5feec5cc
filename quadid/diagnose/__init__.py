"""Diagnosis: what the simulation gets wrong, why, and what the better model gains."""

from quadid.callable_room import make_callable
from quadid.diagnose.pipeline import diagnose as diagnose
from quadid.diagnose.result import Diagnosis as Diagnosis
from quadid.diagnose.selection import Search as Search

make_callable(__name__)
