from collections.abc import Iterator

import pytest

from hdbridge.daemon.memory import Memory


@pytest.fixture(params=[False, True], ids=["ordered", "checked"])
def memory(request: pytest.FixtureRequest) -> Iterator[Memory]:
    """Memory of two axes, for a processor with strong and one with weak ordering."""
    with Memory.create(2, 0.004, checked=request.param) as made:
        yield made
