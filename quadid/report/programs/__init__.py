"""A vehicle's parameters in the forms of other programs: PX4, ArduPilot, Gazebo, RotorPy and others."""

from quadid.report.programs.forms import FORMATS as FORMATS
from quadid.report.programs.forms import FORMS as FORMS
from quadid.report.programs.forms import export as export
