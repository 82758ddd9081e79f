"""Opens regular files only, because opening a named pipe would wait for its writer."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from hdbridge.files.atomic import descriptor_of


def open_regular(path: Path) -> BinaryIO:
    """Opens a file for reading; raises `OSError` for a named pipe, a device or a folder.

    Open files of this process (``/dev/stdin``, and ``/dev/fd/3`` of ``<(command)``) may be of any kind.
    """
    if descriptor_of(path) is None:
        mode = os.stat(path).st_mode  # noqa: PTH116 - follows links such as those in /proc
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(mode):
            kind = "a named pipe" if stat.S_ISFIFO(mode) else "a device or a socket"
            raise OSError(errno.EINVAL, f"it is {kind}; expected a file", os.fspath(path))
    return path.open("rb")
