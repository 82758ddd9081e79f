"""A service on a stepped loop with one simulated axis; a test may be a coroutine."""

import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.service import Service, play, stepped_service


@pytest.fixture
def service(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Service]:
    """A parameter has other arguments of `stepped_service`."""
    with stepped_service(tmp_path, **getattr(request, "param", {})) as made:
        yield made


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Runs a test that is a coroutine to its end."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    play(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}))
    return True
