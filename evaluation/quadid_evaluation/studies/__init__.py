"""Studies: figures of docs/results; one module an experiment, `quadid_evaluation.harness` command line and page."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: workers share the processors
