"""A vehicle's parameters in the forms of other programs: PX4, ArduPilot, Gazebo, RotorPy and others."""

from quadid_report.programs.forms import FORMATS as FORMATS
from quadid_report.programs.forms import FORMS as FORMS
from quadid_report.programs.forms import export as export
from quadid_report.programs.forms import form_of as form_of
from quadid_report.programs.forms import refused as refused
