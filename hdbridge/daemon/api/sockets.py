"""The sockets that the API listens at, bound here and handed to the server as descriptors.

A server that binds a Unix socket by itself makes it writable for everybody (uvicorn: 0666). Here it is bound
with its mode: it is never open to others, not even for a moment.
"""

from __future__ import annotations

import errno
import grp
import ipaddress
import os
import socket
import stat
import struct
from pathlib import Path
from typing import Final, NamedTuple

from hdbridge.errors import DaemonError, InputError

MODE: Final = 0o660
BACKLOG: Final = 128
PATH_MAXIMUM: Final = 107
"""Bytes that the kernel takes for the path of a Unix socket."""
_CREDENTIALS: Final = struct.Struct("3i")


class Peer(NamedTuple):
    """The process at the other end of a Unix socket, as the kernel knows it."""

    pid: int
    uid: int
    gid: int


def unix_socket(path: Path, group: str | None = None) -> socket.socket:
    """A listening Unix socket of mode 0660, owned by ``group`` where one is given.

    A socket that nobody listens at is replaced. DaemonError where another process listens there; InputError
    for a path that is something else, too long, or not writable, and for a group that does not exist.
    """
    if len(os.fsencode(path)) > PATH_MAXIMUM:
        raise InputError(f"{path}: longer than {PATH_MAXIMUM} bytes, which no Unix socket may be; shorten it")
    gid = -1 if group is None else _group(group)
    _clear(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # The file gets the mode of the descriptor when it is bound: it is never open to others.
        os.fchmod(listener.fileno(), MODE)
        listener.bind(os.fspath(path))
        if gid != -1:
            os.chown(path, -1, gid)
        path.chmod(MODE)  # what the umask took from the group
        listener.listen(BACKLOG)
    except OSError as problem:
        listener.close()
        raise InputError(
            f"{path}: cannot be bound: {problem.strerror}; its folder must exist and be writable"
        ) from None
    return listener


def tcp_socket(host: str, port: int, option: str = "api.tcp.port") -> socket.socket:
    """A listening TCP socket; DaemonError where the port is taken, InputError for a host that is none.

    ``option`` is where the port can be changed, for complaints.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (socket.gaierror, UnicodeError):
        raise InputError(f"api.tcp.host: found {host!r}; expected an address of this machine") from None
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
    except OSError as problem:
        listener.close()
        if problem.errno == errno.EADDRINUSE:
            raise DaemonError(
                f"{host}:{port}: another process listens there; stop it, or give {option} another number"
            ) from None
        raise InputError(f"{option}: {host}:{port} cannot be listened at: {problem.strerror}") from None
    return listener


def check_exposure(host: str, *, tls: bool, unencrypted: bool) -> None:
    """InputError where the token would cross a network in the clear and nobody has said that it may."""
    if tls or unencrypted or is_loopback(host):
        return
    raise InputError(
        f"api.tcp.host: found {host!r}, which others reach, without TLS: the token could be read on the way; "
        "give api.tcp.certificate and api.tcp.key, listen at 127.0.0.1, or state api.tcp.unencrypted: true"
    )


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def peer_of(connected: socket.socket) -> Peer | None:
    """Who is at the other end; None of a socket that is not a Unix one."""
    if connected.family != socket.AF_UNIX:
        return None
    found = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return Peer(*_CREDENTIALS.unpack(found))


def _group(name: str) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise InputError(f"api.group: there is no group {name!r} on this machine; create it first") from None


def _clear(path: Path) -> None:
    """Remove what a daemon left there that is no more."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{path}: is not a socket; expected the path of one, or a free one")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except OSError as problem:
            raise InputError(f"{path}: cannot be asked: {problem.strerror or problem}") from None
    raise DaemonError(f"{path}: another daemon listens there; stop it, or give this one another name")
