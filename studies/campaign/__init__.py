"""Blinded campaign: hides effects in flown data, lets the diagnosis look at the log alone, and grades the answer.

python -m studies.campaign --out docs/results
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from studies.campaign.grading import Graded as Graded
from studies.campaign.grading import right as right
from studies.campaign.grading import run as run
from studies.campaign.hidden_cases import GROUPS as GROUPS
from studies.campaign.hidden_cases import SINGLES as SINGLES
from studies.campaign.hidden_cases import Case as Case
from studies.campaign.hidden_cases import cases as cases
from studies.campaign.hidden_cases import flown as flown
