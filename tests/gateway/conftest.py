"""Fixtures: a gateway with a master on the outer bus. The tests are coroutines."""

import inspect

import pytest
from support.gateway import gateway_bench
from support.service import play


@pytest.fixture
def bench(tmp_path, request):
    """Provides a verified axis with its inner drive prepared; an indirect parameter contains options of
    `gateway_bench`.
    """
    options = getattr(request, "param", {})
    with gateway_bench(tmp_path, **(options(tmp_path) if callable(options) else options)) as made:
        yield made


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Runs a test that is a coroutine to its end."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def main():
        bench = given["bench"]
        async with bench.service.ready() as bench.bridge:
            await bench.configure()
            await bench.wait(0.5)
            await pyfuncitem.obj(**given)

    play(main())
    return True
