"""The API, the client and the command line over the real service, on a stepped loop with a simulated drive.

Virtual time runs as fast as it can while the clients think, so the lease is a long one.
"""

import asyncio
from collections.abc import Callable
from contextlib import asynccontextmanager

import pytest
from support.api import served_in_loop
from support.service import Service, play, stepped_service

from hdbridge import Client, InputError, LeaseError, RefusedError
from hdbridge.client import messages


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with stepped_service(tmp_path_factory.mktemp("service"), lease_s=3600.0) as made:
        yield made


@asynccontextmanager
async def served(service: Service):
    path = service.folder / "cell.sock"
    async with service.ready(simulated=True) as bridge, served_in_loop(bridge, path):
        yield path


def with_client(service: Service, use: Callable[[Client], None]) -> None:
    """Runs a client's program in a thread, as if in another process."""

    async def story() -> None:
        async with served(service) as path:

            def program() -> None:
                with Client(path, name="test", timeout_s=60.0) as client:
                    use(client)

            await asyncio.to_thread(program)

    play(story())


def test_a_typical_client_session(service):
    def day(client: Client) -> None:
        axis = client.axis("axis1")
        assert axis.state().state is messages.ControlState.DISABLED
        with pytest.raises(RefusedError):
            axis.move(5)
        axis.enable()
        there = axis.move(5)
        assert there.at_rest
        assert abs(there.error_arcsec) < 60
        with client.lease(), Client(client.address.socket, name="another") as other:
            with pytest.raises(LeaseError, match="'test \\("):
                other.axis("axis1").move(6)
            other.axis("axis1").stop()
        with pytest.raises(InputError):
            axis.move(1e6)
        assert axis.queue([6.0, messages.QueueItem(target_deg=5.5)]).load_target_deg == pytest.approx(5.5)
        axis.compensate("both")
        assert axis.state().scheme is messages.Scheme.BOTH
        assert axis.read("6041h").type == "uint16"
        client.mark("tea")
        assert "tea" in [each.text for each in client.events().events]
        axis.quick_stop()
        stopped = axis.state()
        assert stopped.state is messages.ControlState.QUICK_STOPPED
        assert axis.reset().state is messages.ControlState.DISABLED
        axis.enable()
        assert axis.disable().power is messages.PowerState.SWITCH_ON_DISABLED

    with_client(service, day)
