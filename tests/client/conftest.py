"""A machine of two axes, served, and clients of it."""

import pytest
from support.api import TOKEN

from hdbridge import Client
from hdbridge.client import messages


@pytest.fixture
def api(place):
    """The API of a machine after start-up, with the first axis enabled."""
    place.bridge.__init__()
    place.bridge.axes["joint-1"].at = messages.ControlState.ENABLED
    return place


@pytest.fixture(params=["socket", "tcp"])
def client(api, request):
    address = api.socket if request.param == "socket" else f"http://127.0.0.1:{api.port}"
    with Client(address, token=TOKEN, name="the tests") as client:
        yield client
