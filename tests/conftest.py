"""Settings of all tests: no test asserts wall-clock time, Hypothesis included."""

import gc
import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

for each in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # as the command line does, see hdbridge/__main__.py
    os.environ.setdefault(each, "1")
# Most objects here live as long as the tests do, and a full garbage collection takes half a second.
# With these thresholds a full one is rare unless a test requests it.
gc.set_threshold(20_000, 50, 100)
slow_machines = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
# The same examples in every run: a change fails or passes reproducibly. More of them would find little more.
settings.register_profile("same", slow_machines, derandomize=True, max_examples=50)
settings.register_profile("random", slow_machines)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# A script without job control starts background processes with Ctrl-C ignored, children included.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGQUIT, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.fixture
def at_a_terminal() -> Iterator[None]:
    """Processes that a test starts receive the hang-up of a terminal, even if the tests run under nohup."""
    ours = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, ours)


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """The API of a machine of two axes without drives; a test begins with ``place.bridge.__init__()``."""
    from support.api import served
    from support.fake_bridge import FakeBridge

    with served(FakeBridge(), tmp_path_factory.mktemp("api")) as place:
        yield place
