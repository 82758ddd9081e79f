"""Search for a daemon."""

import socket
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.meanwhile import before_each

from hdbridge.client import address
from hdbridge.client.address import Address, find
from hdbridge.errors import DaemonError, InputError


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A function that listens as the daemon of a given name, and an environment to find it."""
    monkeypatch.setattr(address, "SYSTEM_FOLDER", tmp_path / "system")
    with ExitStack() as stack:

        def listen(name: str, folder: str = "session/hdbridge") -> Path:
            path = tmp_path / folder / f"{name}.sock"
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
            listener = stack.enter_context(socket.socket(socket.AF_UNIX))
            listener.bind(str(path))
            listener.listen()
            return path

        (tmp_path / "session").mkdir()
        listen.environment = {"XDG_RUNTIME_DIR": str(tmp_path / "session")}
        yield listen


def test_a_single_daemon_needs_no_address(machine):
    path = machine("cell")
    assert find(environment=machine.environment) == Address(socket=path)
    assert find("cell", environment=machine.environment).socket == path


def test_one_of_several_daemons_is_chosen_by_name(machine):
    machine("cell")
    other = machine("press", "system/press")
    with pytest.raises(DaemonError, match=r"2 daemons run: .*cell\.sock, .*press\.sock"):
        find(environment=machine.environment)
    assert find("press", environment=machine.environment).socket == other
    with pytest.raises(DaemonError, match="'mill'"):
        find("mill", environment=machine.environment)


def test_a_dead_socket_is_not_a_daemon(machine, tmp_path):
    path = machine("cell")
    dead = path.with_name("dead.sock")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(dead))
    assert find(environment=machine.environment).socket == path


def test_a_daemon_ending_during_the_search_is_not_found(machine, tmp_path):
    machine("cell", "system/cell")
    folder = tmp_path / "system" / "cell"

    def hook(event: str, path: Path) -> None:
        if event == "os.scandir" and path == folder and folder.exists():
            (folder / "cell.sock").unlink()
            folder.rmdir()

    with before_each(hook), pytest.raises(DaemonError, match="no daemon runs"):
        find(environment=machine.environment)


def test_a_world_writable_folder_is_not_trusted(machine):
    """Below /tmp another user could put a socket in the daemon's place."""
    path = machine("cell")
    path.parent.chmod(0o777)
    with pytest.raises(DaemonError, match="no daemon runs"):
        find(environment=machine.environment)


def test_an_argument_takes_precedence_over_the_environment(machine, tmp_path):
    machine("cell")
    given = {**machine.environment, "HDBRIDGE_SOCKET": str(tmp_path / "a.sock")}
    assert find(environment=given).socket == tmp_path / "a.sock"
    assert find("/run/b.sock", environment=given).socket == Path("/run/b.sock")
    by_url = {"HDBRIDGE_URL": "https://cell.example:8402/", "HDBRIDGE_TOKEN": "secret"}
    assert find(environment=by_url) == Address(url="https://cell.example:8402", token="secret")
    assert find(environment=by_url).websocket_url == "wss://cell.example:8402"


@pytest.mark.parametrize(
    "wrong",
    ["http://", "https://cell/api", "http://user:pass@cell", "http://cell?token=x", "cell one", "http://a b"],
)
def test_an_invalid_address_is_refused(machine, wrong):
    with pytest.raises(InputError, match="expected"):
        find(wrong, environment=machine.environment)
