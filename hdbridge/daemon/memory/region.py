"""A mapped memfd, as bytes and as cells.

A memfd has no name in any file system: no other process can open it, and it is freed with the last process
that holds it, however that one dies. It is sealed against shrinking, so that no access can fail later.
"""

import fcntl
import mmap
import os
from typing import Self


class Region:
    """A mapped region of shared memory."""

    def __init__(self, fd: int, size: int, *, checked: bool) -> None:
        self.fd = fd
        """Descriptor to pass to another process."""
        self.checked = checked
        """True if slots have checksums."""
        self._map = mmap.mmap(fd, size)
        self.view = memoryview(self._map)
        self._cells = self.view.cast("q")

    @classmethod
    def create(cls, size: int, *, checked: bool) -> Self:
        """Creates a region, all zero."""
        fd = os.memfd_create("hdbridge", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            return cls(fd, size, checked=checked)
        except OSError:
            os.close(fd)
            raise

    def cells(self, offset: int, count: int) -> memoryview:
        """Returns ``count`` aligned int64 cells, which are read and written atomically."""
        return self._cells[offset // 8 : offset // 8 + count]

    def close(self) -> None:
        """Unmaps the memory, unless arrays of samples still refer to it, and closes the descriptor."""
        try:
            self._cells.release()
            self.view.release()
            self._map.close()
        except BufferError:
            pass  # the last reference unmaps it
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
