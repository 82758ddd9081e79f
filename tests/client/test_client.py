"""The synchronous client against the served API."""

import os
import pwd
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from support.api import TOKEN
from support.patience import until

from hdbridge import Client, DaemonError, InputError, LeaseError, RefusedError, SafetyStop
from hdbridge.client import messages
from hdbridge.client.aio import STOPS_SENT

USER = pwd.getpwuid(os.getuid()).pw_name


def test_one_line_moves_an_axis_and_releases_the_lease(api, monkeypatch):
    monkeypatch.setenv("HDBRIDGE_SOCKET", str(api.socket))
    assert Client().axis("joint-1").move(30).load_target_deg == 30.0
    assert api.bridge.moved == [("joint-1", "move", 30.0, None)]
    assert not api.bridge.state().lease.held


def test_the_state_is_typed(client):
    state = client.state()
    assert state.name == "cell"
    assert state.axes[0].limits.velocity_deg_s == 60.0
    assert list(client.axes) == ["joint-1", "joint-2"]
    assert client.axis("joint-2").state().state is messages.ControlState.DISABLED


def test_coordinated_moves_objects_and_marks(client, api):
    client.axis("joint-2").enable()
    client.coordinated({"joint-1": 1, "joint-2": 2}, speed=0.5)
    assert [each.load_target_deg for each in client.state().axes] == [1.0, 2.0]
    assert client.axis("joint-1").read("Statusword").value == 0x1237
    (event,) = client.mark("coupling tightened")
    assert client.events(event.sequence).events == []


def test_the_lease_is_held_and_renewed_within_the_block(api):
    bridge = api.bridge
    bridge.now_s, bridge.lease = 0.0, type(bridge.lease)(0.3, bridge.lease._now)
    with Client(api.socket, name="patience") as client:
        with client.lease() as grant:
            for _ in range(4):
                bridge.now_s += 0.2
                until(lambda: bridge.lease.holder.expires_s == bridge.now_s + 0.3)
            assert bridge.lease.holds(grant.token)
            assert client.lease_state().client == f"patience ({USER}, process {os.getpid()})"
            client.axis("joint-1").move(1)
            with client.lease() as inner:
                assert inner.token == grant.token
        assert not client.lease_state().held


def test_another_client_is_refused_or_takes_the_lease_by_force(api):
    with Client(api.socket, name="one") as one, Client(api.socket, name="two") as two:
        with one.lease():
            with pytest.raises(LeaseError, match="'one \\("):
                two.axis("joint-1").move(1)
            with two.lease(force=True):
                two.axis("joint-1").move(2)
                with pytest.raises(LeaseError, match="'two \\("):
                    one.axis("joint-1").move(3)
        two.axis("joint-1").move(4)
    assert [each[2] for each in api.bridge.moved] == [2.0, 4.0]


def test_threads_share_the_lease_of_a_client(api):
    api.bridge.axes["joint-2"].at = messages.ControlState.ENABLED
    for each in api.bridge.axes.values():
        each.moving_s = 0.2
    with Client(api.socket) as client:
        threads = [
            threading.Thread(target=client.axis(name).move, args=(7,)) for name in ("joint-1", "joint-2")
        ]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
    assert sorted(each[0] for each in api.bridge.moved) == ["joint-1", "joint-2"]
    assert not api.bridge.state().lease.held


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda c: c.axis("joint-9").state(), InputError, "joint-1, joint-2"),
        (lambda c: c.axis("joint-2").move(1), RefusedError, "enable it first"),
        (lambda c: c.axis("joint-1").move(181), InputError, "-180 to 180"),
        (lambda c: c.axis("joint-1").move(float("nan")), InputError, "target_deg"),
        (lambda c: c.axis("joint-1").move("30"), InputError, "target_deg: found '30'"),
        (lambda c: c.axis("joint-1").compensate("bth"), InputError, "scheme"),
        (lambda c: c.axis("../../lease").state(), InputError, "joint-1, joint-2|Not Found"),
        (lambda c: c.axis("joint-1").jog(1.0), LeaseError, "client.lease"),
        (lambda c: c.axis("joint-1").queue([1.0], wait=False), LeaseError, "client.lease"),
    ],
)
def test_refusals_raise_the_library_errors(client, api, call, error, words):
    with pytest.raises(error, match=words):
        call(client)
    assert api.bridge.moved == []
    assert not api.bridge.state().lease.held


def test_an_interrupted_call_is_given_up_and_the_lease_released(api):
    api.bridge.axes["joint-1"].moving_s = 30.0

    def interrupt():
        until(lambda: api.bridge.moved)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    interrupting = threading.Thread(target=interrupt)
    interrupting.start()
    with Client(api.socket) as client, pytest.raises(KeyboardInterrupt):
        client.axis("joint-1").move(7)
    interrupting.join()
    until(lambda: not api.bridge.state().lease.held)


def test_a_timed_jog_is_renewed_and_ends_in_a_stop(client, api):
    client.axis("joint-1").jog(5.0, duration_s=0.4)
    assert len(api.bridge.moved) >= 2
    assert api.bridge.stopped == [("joint-1", "stop")]


def once_queued(axis, act):
    """Starts a thread that acts once moves wait in the queue."""

    def run():
        while not axis.queued:
            time.sleep(0.001)
        act()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_queue_waits_until_it_is_empty(client, api):
    axis = api.bridge.axes["joint-1"]
    reached = once_queued(axis, axis.queued.clear)
    client.axis("joint-1").queue([1.0, 2.0])
    reached.join()
    assert axis.queued == []


def test_a_stop_ends_the_wait_with_its_reason(client, api):
    axis = api.bridge.axes["joint-1"]
    stopping = once_queued(axis, lambda: setattr(axis, "at", messages.ControlState.QUICK_STOPPED))
    with pytest.raises(SafetyStop, match="a TPDO is missing; check the cable"):
        client.axis("joint-1").queue([1.0, 2.0])
    stopping.join()


def test_a_path_is_streamed_and_the_lease_released(client, api):
    with client.axis("joint-1").stream(timeout_s=0.2) as stream:
        stream.put([(0.0, 0.0), (0.1, 0.5, 5.0)])
        stream.put(messages.StreamPoint(time_s=0.2 + 0.01 * n, position_deg=1.0) for n in range(450))
    (given,) = api.bridge.streams
    assert len(given.points) == 452
    assert given.ended
    assert not api.bridge.state().lease.held


def test_a_refused_point_or_an_error_ends_the_stream(client, api):
    with pytest.raises(InputError, match="-180 to 180"), client.axis("joint-1").stream() as stream:
        stream.put([(0.0, 999.0)])
    with pytest.raises(OSError, match="mine"), client.axis("joint-1").stream():
        raise OSError("mine")
    with pytest.raises(RefusedError, match="enable it first"), client.axis("joint-2").stream():
        pass
    assert not api.bridge.state().lease.held


def test_samples_are_received_live(client):
    cycles: list[int] = []
    for samples in client.live(every=5, axes=["joint-2"]):
        if set(samples.axes) == {"joint-2"}:  # not yet in samples from before the request arrived
            cycles += samples.cycle
        if len(cycles) > 10:
            break
    assert all(each % 5 == 0 for each in cycles)


@pytest.mark.parametrize(("stops", "connections"), [(True, STOPS_SENT), (False, 1)])
def test_a_stop_is_sent_again_if_the_connection_is_lost_and_nothing_else_is(stops, connections):
    seen = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def drop() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                seen.append(connection.recv(4))
                connection.close()

        threading.Thread(target=drop, daemon=True).start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        lost = pytest.raises(DaemonError, match="the outcome is unknown")
        with Client(address, token="-") as client, lost:
            client.stop() if stops else client.mark("here")
        server.shutdown(socket.SHUT_RDWR)
    assert seen == [b"POST"] * connections


def test_without_a_daemon_the_error_explains_how_to_start_one(tmp_path, monkeypatch):
    for name in ("HDBRIDGE_SOCKET", "HDBRIDGE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(DaemonError, match="hdbridge run"):
        Client("no-such-cell")
    with Client(tmp_path / "gone.sock") as client, pytest.raises(DaemonError, match="hdbridge run"):
        client.state()


def test_a_wrong_token_is_reported(api):
    with (
        Client(f"http://127.0.0.1:{api.port}", token="not-the-token-at-all") as client,
        pytest.raises(DaemonError, match="token"),
    ):
        client.state()
    with (
        Client(f"http://127.0.0.1:{api.port}", token="not-the-token-at-all") as client,
        pytest.raises(DaemonError, match="token"),
    ):
        next(client.live())


def test_the_token_comes_from_the_environment(api, monkeypatch):
    monkeypatch.delenv("HDBRIDGE_SOCKET", raising=False)
    monkeypatch.setenv("HDBRIDGE_URL", f"http://127.0.0.1:{api.port}/")
    monkeypatch.setenv("HDBRIDGE_TOKEN", TOKEN)
    with Client() as client:
        assert client.state().name == "cell"


def test_neither_client_nor_messages_import_the_daemon():
    program = (
        "import hdbridge, sys\nfrom hdbridge.client import messages\n"
        "assert 'httpx' not in sys.modules\nhdbridge.Client, hdbridge.AsyncClient\n"
        "print([m for m in sys.modules if m.startswith(('hdbridge.daemon', 'fastapi', 'numpy', 'can'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("missing", ["httpx", "websockets"])
def test_missing_extra_is_named(missing):
    program = (
        f"import sys\nsys.modules[{missing!r}] = None\nimport hdbridge\n"
        "try:\n    hdbridge.Client\nexcept hdbridge.InputError as error:\n    print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env={**os.environ}
    )
    assert "pip install 'hdbridge[daemon]'" in done.stdout


def test_a_connection_that_breaks_is_described(tmp_path):
    """The daemon is killed before it has read the request; the system's error has no text of its own."""
    path = tmp_path / "broken.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def break_off() -> None:
            connected, _ = listener.accept()
            with connected:
                connected.recv(1)  # the rest of the request is unread

        breaking = threading.Thread(target=break_off)
        breaking.start()
        with pytest.raises(DaemonError, match=r"the daemon disconnected \(\w.*\)"), Client(path) as client:
            client.state()
        breaking.join()
