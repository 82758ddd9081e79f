"""Memory region: created by one process, passed to others as a descriptor, mapped by each.

A memfd has no name in any file system: no other process can open it, and it is freed with the last process
that holds it, however that one dies. It is sealed against shrinking, so that no access can fail later.
"""

import fcntl
import mmap
import os
import platform
import zlib
from typing import Final, Self

from hdbridge.daemon.memory.layout import AXES_AT_MOST, HEADER, MAGIC, VERSION, Layout
from hdbridge.errors import InputError

_STRONGLY_ORDERED: Final = frozenset({"x86_64", "amd64", "i386", "i586", "i686"})
ORDERED: Final = platform.machine().lower() in _STRONGLY_ORDERED
"""True if other processors see the stores of one in program order."""


class Region:
    """A mapped region of shared memory with an identifying header."""

    def __init__(self, fd: int, size: int, *, checked: bool) -> None:
        self.fd = fd
        """Descriptor to pass to another process."""
        self.checked = checked
        """True if slots have checksums."""
        self._map = mmap.mmap(fd, size)
        self.view = memoryview(self._map)
        self._cells = self.view.cast("q")

    @classmethod
    def create(cls, layout: Layout, period_ns: int, *, checked: bool) -> Self:
        """Creates memory, all zero but for its header. ``checked``: slots have checksums."""
        fd = os.memfd_create("hdbridge", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(fd, layout.total)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            region = cls(fd, layout.total, checked=checked)
        except OSError:
            os.close(fd)
            raise
        HEADER.pack_into(
            region.view, 0, MAGIC, VERSION, layout.axes, period_ns, layout.total, _sizes(layout), checked
        )
        return region

    @classmethod
    def attach(cls, fd: int) -> tuple[Self, Layout, int]:
        """Attaches to another process's memory; returns it, its layout and the period in ns.

        Raises `InputError` if the descriptor is not hdbridge's memory, or of another version.
        """
        try:
            size = os.fstat(fd).st_size
            head = os.pread(fd, HEADER.size, 0)
        except OSError as error:
            raise InputError(
                f"descriptor {fd}: cannot be read as shared memory: {error.strerror}; it is handed down by "
                "'hdbridge run', not given by hand"
            ) from error
        if len(head) < HEADER.size or head[: len(MAGIC)] != MAGIC:
            raise InputError(f"descriptor {fd}: is not the shared memory of hdbridge; start 'hdbridge run'")
        _, version, axes, period_ns, total, sizes, checked = HEADER.unpack(head)
        if version != VERSION:
            raise InputError(
                f"descriptor {fd}: shared memory of version {version}, expected {VERSION}: the processes are "
                "of different releases of hdbridge; restart the whole daemon"
            )
        if not 1 <= axes <= AXES_AT_MOST or not period_ns:
            raise InputError(f"descriptor {fd}: shared memory of {axes} axes and {period_ns} ns: damaged")
        layout = Layout.of(axes)
        if total != layout.total or size != total or sizes != _sizes(layout):
            raise InputError(
                f"descriptor {fd}: shared memory of {size} bytes, expected {layout.total} for {axes} axes: "
                "another release of hdbridge has made it; restart the whole daemon"
            )
        return cls(fd, size, checked=bool(checked)), layout, period_ns

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


def _sizes(layout: Layout) -> int:
    return zlib.crc32(repr(layout).encode())
