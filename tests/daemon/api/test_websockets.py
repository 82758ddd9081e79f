"""The two WebSockets: samples for watchers, set-points from the holder of the lease."""

import json
import logging
import socket
from contextlib import ExitStack

import pytest
from support.api import TOKEN
from support.patience import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect, unix_connect

from hdbridge.client import messages


def live(api, **options):
    # A full queue of this client would keep it from closing.
    return unix_connect(str(api.socket), "ws://hdbridge/api/v1/live", max_queue=None, **options)


def stream(api, axis="joint-1"):
    return unix_connect(str(api.socket), f"ws://hdbridge/api/v1/axes/{axis}/stream")


def batch(connection) -> messages.Samples:
    return messages.Samples.model_validate_json(connection.recv())


def next_answer(connection) -> messages.StreamAnswer:
    return messages.StreamAnswer.model_validate_json(connection.recv())


def read_on(connection) -> None:
    """Reads until the connection is closed."""
    while True:
        connection.recv()


def test_samples_come_in_columns_with_null_for_nan(api):
    with live(api) as connection:
        samples = batch(connection)
    assert len(samples.time_s) == len(samples.cycle) == len(samples.axes["joint-2"].weight)
    axis = samples.axes["joint-1"]
    assert axis.error_arcsec[0] == pytest.approx(1.0)
    assert axis.reading0[0] is None
    assert axis.state[0] == "enabled"


def test_a_client_chooses_axes_and_how_many_samples(api):
    with live(api) as connection:
        connection.send(messages.LiveOptions(every=10, axes=["joint-2"]).model_dump_json())
        until(lambda: set(batch(connection).axes) == {"joint-2"})
        cycles = [cycle for _ in range(5) for cycle in batch(connection).cycle]
    assert len(cycles) >= 5
    assert all(each % 10 == 0 for each in cycles)


def test_only_new_events_come_with_the_samples(api):
    api.bridge.mark("before")
    with live(api) as connection:
        batch(connection)
        api.bridge.mark("while it watches")
        seen = []
        until(lambda: seen.extend(batch(connection).events) or seen)
    assert [each.text for each in seen] == ["while it watches"]


@pytest.mark.parametrize(
    "wrong", ["{", "[]", '{"every": 0}', '{"every": NaN}', '{"axes": ["joint-9"]}', '{"evry": 3}', b"bytes"]
)
def test_an_invalid_request_ends_the_connection_with_a_reason(api, wrong):
    with live(api) as connection:
        connection.send(wrong)
        with pytest.raises(ConnectionClosed) as closed:
            read_on(connection)
    assert closed.value.rcvd.code == 1008
    assert closed.value.rcvd.reason


def test_a_slow_client_loses_only_its_own_samples(api):
    """A client that reads nothing for thousands of cycles then receives the newest samples, and the number of
    those that were dropped.
    """
    api.bridge.rows = 40

    def next_of(connection, last: int) -> messages.Samples:
        samples = batch(connection)
        assert samples.cycle == list(range(samples.cycle[0], samples.cycle[-1] + 1))
        assert samples.cycle[0] == last + 1 + samples.lost
        return samples

    with socket.socket(socket.AF_UNIX) as raw:
        raw.connect(str(api.socket))
        # Small buffers, so that little data is in transit.
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with (
            unix_connect(None, "ws://hdbridge/api/v1/live", sock=raw, max_queue=1) as sleeper,
            live(api) as reader,
        ):
            begun = last = batch(reader).cycle[-1]
            read = lost_by_reader = 0
            while last < begun + 20_000:
                samples = next_of(reader, last)
                read += len(samples.cycle)
                lost_by_reader += samples.lost
                last = samples.cycle[-1]
            asleep = batch(sleeper).cycle[-1]
            seen = lost = 0
            while lost <= seen:
                samples = next_of(sleeper, asleep)
                seen += len(samples.cycle)
                lost += samples.lost
                asleep = samples.cycle[-1]
    assert read + lost_by_reader == last - begun >= 20_000
    assert lost_by_reader < lost


def test_the_number_of_watchers_is_limited(api):
    with ExitStack() as open_now:
        for _ in range(32):
            open_now.enter_context(live(api))
        with pytest.raises(InvalidStatus) as refused, live(api):
            pass
    assert refused.value.response.status_code == 503


def over_tcp(api, **options):
    return connect(f"ws://127.0.0.1:{api.port}/api/v1/live", proxy=None, **options)


@pytest.mark.parametrize(
    "subprotocols", [None, ["hdbridge.v1"], ["hdbridge.v1", "bearer.wrong-token-of-old"]]
)
def test_watching_over_tcp_needs_the_token(api, subprotocols):
    with pytest.raises(InvalidStatus) as refused, over_tcp(api, subprotocols=subprotocols):
        pass
    assert refused.value.response.status_code == 401
    assert json.loads(refused.value.response.body)["title"] == "Unauthorized"


@pytest.mark.parametrize(
    "shown",
    [
        {"subprotocols": ["hdbridge.v1", f"bearer.{TOKEN}"]},
        {"additional_headers": {"Authorization": f"Bearer {TOKEN}"}},
    ],
)
def test_the_token_subprotocol_of_a_browser_is_not_echoed(api, shown, caplog):
    caplog.set_level(logging.DEBUG)
    with over_tcp(api, origin=f"http://127.0.0.1:{api.port}", **shown) as connection:
        assert batch(connection).cycle
        assert connection.subprotocol in {None, "hdbridge.v1"}
        assert TOKEN not in str(connection.response.headers)
    server = [each for each in caplog.records if not each.name.startswith("websockets.client")]
    assert TOKEN not in "\n".join(f"{each.getMessage()} {each.args}" for each in server)


def test_a_page_of_another_origin_cannot_watch(api):
    shown = {"Authorization": f"Bearer {TOKEN}"}
    with (
        pytest.raises(InvalidStatus) as refused,
        over_tcp(api, origin="https://evil.example", additional_headers=shown),
    ):
        pass
    assert refused.value.response.status_code == 403


@pytest.fixture
def lease(api):
    """The lease, held, with the first axis enabled."""
    token = api.bridge.lease.take("stream")
    api.bridge.axes["joint-1"].at = messages.ControlState.ENABLED
    return token


def begin(connection, lease) -> None:
    connection.send(json.dumps({"lease": lease, "timeout_s": 0.2}))


def points(*positions_deg: float, end: bool = False) -> str:
    return messages.StreamPoints(
        points=[
            messages.StreamPoint(time_s=0.01 * number, position_deg=each, velocity_deg_s=0.0)
            for number, each in enumerate(positions_deg)
        ],
        end=end,
    ).model_dump_json()


def test_stream_points_are_accepted_and_acknowledged(api, lease):
    with stream(api) as connection:
        begin(connection, lease)
        assert next_answer(connection).accepted == 0
        connection.send(points(0.0, 0.1, 0.2))
        assert next_answer(connection).accepted == 3
        connection.send(points(0.3, end=True))
        assert next_answer(connection).accepted == 1
        with pytest.raises(ConnectionClosed) as closed:
            connection.recv()
    assert closed.value.rcvd.code == 1000
    (given,) = api.bridge.streams
    assert [each.position_deg for each in given.points] == [0.0, 0.1, 0.2, 0.3]
    assert given.ended
    assert api.bridge.moved == [("joint-1", "stream", 0.2)]


@pytest.mark.parametrize(
    "first",
    ['{"lease": "mZ3s"}', '{"lease": ""}', "{}", "{", '{"lease": "mZ3s", "timeout_s": 60}', '{"points": []}'],
)
def test_streaming_needs_the_lease(api, lease, first):
    with stream(api) as connection:
        connection.send(first)
        answer = next_answer(connection)
        assert answer.accepted == 0
        assert answer.problem
        with pytest.raises(ConnectionClosed):
            connection.recv()
    assert api.bridge.streams == []
    assert api.bridge.moved == []


def test_a_disabled_or_unknown_axis_is_reported(api, lease):
    for axis, words in (("joint-2", "enable it first"), ("joint-9", "joint-1, joint-2")):
        with stream(api, axis) as connection:
            begin(connection, lease)
            assert words in next_answer(connection).problem.detail


@pytest.mark.parametrize(
    "wrong",
    [
        points(181.0),
        '{"points": [{"time_s": 0, "position_deg": NaN, "velocity_deg_s": 0}]}',
        '{"points": [{"time_s": -1, "position_deg": 0, "velocity_deg_s": 0}]}',
        '{"points": 3}',
    ],
)
def test_an_invalid_point_ends_the_stream_with_a_reason(api, lease, wrong):
    with stream(api) as connection:
        begin(connection, lease)
        next_answer(connection)
        connection.send(wrong)
        assert next_answer(connection).problem
        with pytest.raises(ConnectionClosed):
            connection.recv()
    (given,) = api.bridge.streams
    until(lambda: given.ended)
    assert given.points == []


def test_losing_the_lease_ends_the_stream(api, lease):
    with stream(api) as connection:
        begin(connection, lease)
        next_answer(connection)
        api.bridge.lease.take("another", force=True)
        connection.send(points(0.0))
        assert "another" in next_answer(connection).problem.detail


def test_the_stream_ends_with_its_client(api, lease):
    with stream(api) as connection:
        begin(connection, lease)
        next_answer(connection)
        connection.socket.shutdown(socket.SHUT_RDWR)
        (given,) = api.bridge.streams
        until(lambda: given.ended)
