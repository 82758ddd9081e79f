"""The runtime folder, which contains a daemon's socket while it runs."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from hdbridge.client.address import session_folder
from hdbridge.errors import InputError


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Returns the runtime folder, created if necessary; raises InputError if others can access it.

    It is the service manager's, else the session's (``$XDG_RUNTIME_DIR/hdbridge``), else one of this user
    under ``/tmp``.
    """
    given = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)  # the service manager has made it, with the mode that its unit asks for
    folder = session_folder(environment)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as problem:
        raise InputError(
            f"{folder}: cannot be made: {problem.strerror}; it holds the daemon's socket, see XDG_RUNTIME_DIR"
        ) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise InputError(
            f"{folder}: is not a folder of this user alone (mode 700); remove it, or set XDG_RUNTIME_DIR"
        )
    return folder


def socket_path(name: str, folder: Path, given: Path | None = None) -> Path:
    """Returns the path of the API's socket: the machine file's, else NAME.sock in the runtime folder."""
    return given if given is not None else folder / f"{name}.sock"
