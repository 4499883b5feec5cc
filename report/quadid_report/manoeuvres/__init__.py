"""A manoeuvre in the forms in which it is flown: scripts for autopilots, parameters, words for the sticks."""

from quadid_report.manoeuvres.forms import FORMS as FORMS
from quadid_report.manoeuvres.forms import check_form as check_form
from quadid_report.manoeuvres.forms import written_as as written_as
