"""`tools/compile_tests.py` writes the files that pytest looks for."""

import subprocess
import sys
from pathlib import Path

TOOL = Path(__file__).parents[2] / "tools" / "compile_tests.py"


def test_pytest_uses_precompiled_tests(pytester, monkeypatch):
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    pytester.makepyfile(test_sum="def test_sum():\n    assert 1 + 1 == 2\n")
    subprocess.run([sys.executable, TOOL, pytester.path], check=True)
    (kept,) = pytester.path.rglob("test_sum.*.pyc")
    made = kept.stat()
    pytester.runpytest_subprocess("-q", "--disable-plugin-autoload").assert_outcomes(passed=1)
    assert [*pytester.path.rglob("test_sum.*.pyc")] == [kept]
    assert (kept.stat().st_ino, kept.stat().st_mtime_ns) == (made.st_ino, made.st_mtime_ns)
