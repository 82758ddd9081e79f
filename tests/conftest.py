"""What all tests share: no test asserts wall-clock time, Hypothesis included."""

from hypothesis import HealthCheck, settings

settings.register_profile("hdbridge", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("hdbridge")
