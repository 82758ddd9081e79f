"""What all tests share: no test asserts wall-clock time, Hypothesis included."""

import os

from hypothesis import HealthCheck, settings

for each in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # as the command line does, see hdbridge/__main__.py
    os.environ.setdefault(each, "1")
settings.register_profile("hdbridge", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("hdbridge")
