"""Memory that Python asks for is there at once with `tools/uml/guest/populate.c` under it."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "tools" / "uml" / "guest" / "populate.c"
PAGES_OF_AN_ARENA = """
import ctypes, mmap
held = mmap.mmap(-1, 1 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
first = ctypes.addressof(ctypes.c_char.from_buffer(held))
pages = ctypes.create_string_buffer((1 << 20) // 4096)
assert ctypes.CDLL(None).mincore(ctypes.c_void_p(first), ctypes.c_size_t(1 << 20), pages) == 0
print(sum(page & 1 for page in pages.raw))
"""


@pytest.mark.skipif(
    shutil.which("cc") is None or (sys.platform, platform.machine()) != ("linux", "x86_64"),
    reason="needs a C compiler, and Linux on x86-64",
)
def test_memory_is_populated_before_it_is_touched(tmp_path):
    library = tmp_path / "populate.so"
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, SOURCE], check=True)

    def pages(**environment):
        return subprocess.run(
            [sys.executable, "-c", PAGES_OF_AN_ARENA],
            env={**os.environ, **environment}, capture_output=True, text=True, check=True,
        ).stdout.strip()  # fmt: skip

    assert pages() == "0"
    assert pages(LD_PRELOAD=str(library)) == "256"
