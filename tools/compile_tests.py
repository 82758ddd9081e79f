"""Rewrites the assertions of all tests and caches the result, so that the workers of pytest-xdist need not.

    python tools/compile_tests.py [FOLDER]

It does what pytest does when it imports a test, but without importing it. Pytest has no public interface for
this; if another version lacks the private one, nothing is done here, and the workers rewrite the tests.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from _pytest.assertion import rewrite
from _pytest.config import get_config

TESTS = Path(__file__).resolve().parents[1] / "tests"


def main(tests: Path) -> None:
    """Writes the cache files that pytest would write into the ``__pycache__`` folders."""
    config = get_config()
    config.parse(["--disable-plugin-autoload"])
    for path in sorted((*tests.rglob("test_*.py"), *tests.rglob("conftest.py"))):
        kept = rewrite.get_cache_dir(path) / f"{path.stem}{rewrite.PYC_TAIL}"
        if rewrite._read_pyc(path, kept) is None:
            source_hash, code = rewrite._rewrite_test(path, config)
            kept.parent.mkdir(exist_ok=True)
            rewrite._write_pyc(config.stash[rewrite.assertstate_key], code, source_hash, kept)


if __name__ == "__main__":
    with suppress(AttributeError, TypeError, ValueError):
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else TESTS)
