"""A machine of two axes, served."""

import pytest


@pytest.fixture
def api(place):
    """Machine after its start, with a free lease."""
    place.bridge.__init__()
    return place


@pytest.fixture
def leased(api):
    """A client over the Unix socket that holds the lease, the first axis enabled."""
    token = api.bridge.lease.take("the tests")
    with api.over_socket(**{"X-Lease": token}) as client:
        client.post("/axes/joint-1/enable").raise_for_status()
        api.bridge.moved.clear()
        yield client
