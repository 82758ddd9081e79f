"""The runtime folder: where a daemon's socket lies while it runs."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from hdbridge.client.address import session_folder
from hdbridge.errors import InputError


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """The folder, made where it is not there yet; InputError where it is not ours alone.

    That of the service manager, else that of the session (``$XDG_RUNTIME_DIR/hdbridge``), else one for this
    user under ``/tmp``.
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
    """The API's socket: the one that the machine file names, else NAME.sock in the runtime folder."""
    return given if given is not None else folder / f"{name}.sock"
