"""Blinded campaign: hides effects in flown data, lets the diagnosis look at the log alone, and grades the answer.

python -m quadid_evaluation.studies.campaign --out docs/results
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_evaluation.studies.campaign.grading import Graded as Graded
from quadid_evaluation.studies.campaign.grading import right as right
from quadid_evaluation.studies.campaign.grading import run as run
from quadid_evaluation.studies.campaign.hidden_cases import GROUPS as GROUPS
from quadid_evaluation.studies.campaign.hidden_cases import SINGLES as SINGLES
from quadid_evaluation.studies.campaign.hidden_cases import Case as Case
from quadid_evaluation.studies.campaign.hidden_cases import cases as cases
from quadid_evaluation.studies.campaign.hidden_cases import flown as flown
