"""Listening sockets of the API, bound here and passed to the server as descriptors.

A server that binds a Unix socket itself makes it writable for all users (uvicorn: 0666). Here the socket is
bound with its final mode, so it is never open to others, not even for a moment.
"""

import errno
import grp
import os
import socket
import stat
import struct
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from hdbridge.drive.interfacelock import command_line, process_words
from hdbridge.errors import DaemonError, InputError

MODE: Final = 0o660
LOOPBACK: Final = "127.0.0.1"
BACKLOG: Final = 1024
PATH_MAXIMUM: Final = 107
"""Maximum length of a Unix socket's path, bytes."""
_CREDENTIALS: Final = struct.Struct("3i")


class Peer(NamedTuple):
    """Process at the other end of a Unix socket, as identified by the kernel."""

    pid: int
    uid: int
    gid: int


def unix_socket(path: Path, group: str | None = None) -> socket.socket:
    """Returns a listening Unix socket of mode 0660, with ``group`` as its group if given.

    Replaces a socket that nobody listens on. Raises DaemonError if another process listens there, and
    InputError for a path that is not a socket, too long or not writable, and for an unknown group.
    """
    if len(os.fsencode(path)) > PATH_MAXIMUM:
        raise InputError(f"{path}: longer than {PATH_MAXIMUM} bytes, which no Unix socket may be; shorten it")
    gid = -1 if group is None else _group(group)
    _clear(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # The bind creates the file with the descriptor's mode, so it is never open to others.
        os.fchmod(listener.fileno(), MODE)
        listener.bind(os.fspath(path))
        if gid != -1:
            os.chown(path, -1, gid)
        path.chmod(MODE)  # restores group permissions that the umask removed
        listener.listen(BACKLOG)
    except OSError as problem:
        listener.close()
        raise InputError(
            f"{path}: cannot be bound: {problem.strerror}; its folder must exist and be writable"
        ) from None
    return listener


def file_of(path: Path) -> tuple[int, int]:
    """Returns device and inode of a socket file, which identify the bound file."""
    found = path.lstat()
    return found.st_dev, found.st_ino


def tcp_socket(port: int, option: str = "api.tcp.port") -> socket.socket:
    """Returns a listening TCP socket on the loopback address.

    Raises DaemonError if the port (from ``option``) is in use, InputError if it cannot be bound.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port))
        listener.listen(BACKLOG)
    except OSError as problem:
        listener.close()
        if problem.errno == errno.EADDRINUSE:
            raise DaemonError(
                f"{LOOPBACK}:{port}: another process listens there; stop it, or give {option} another number"
            ) from None
        raise InputError(f"{LOOPBACK}:{port}: {option} cannot be bound: {problem.strerror}") from None
    return listener


def peer_of(connected: socket.socket) -> Peer | None:
    """Returns the peer of a Unix socket; None for other sockets."""
    if connected.family != socket.AF_UNIX:
        return None
    found = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return Peer(*_CREDENTIALS.unpack(found))


def daemon_of(connected: socket.socket) -> int:
    """Returns the process id of the daemon (its keeper) at the other end of a Unix socket.

    Returns that of the service if the keeper is gone. The service then ends, too.
    """
    peer = peer_of(connected)
    assert peer is not None
    if "hdbridge.daemon.serve" in command_line(peer.pid):
        with suppress(OSError):
            status = Path(f"/proc/{peer.pid}/stat").read_text(encoding="utf-8")
            parent = int(status.rpartition(")")[2].split()[1])
            if "hdbridge" in command_line(parent):
                return parent
    return peer.pid


def _group(name: str) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise InputError(f"api.group: there is no group {name!r} on this machine; create it first") from None


def _clear(path: Path) -> None:
    """Removes the socket file of a daemon that no longer runs; raises DaemonError if one listens there."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{path}: not a socket; expected a socket, or a path that does not exist yet")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except OSError as problem:
            raise InputError(f"{path}: cannot be asked: {problem.strerror or problem}") from None
        number = daemon_of(probe)
    raise DaemonError(
        f"{path}: another daemon listens there ({process_words(number)}); ask it with 'hdbridge ctl', end it "
        f"with 'kill {number}', or give this one another name"
    )
