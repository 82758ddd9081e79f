"""No test fails because the computer is busy: waits for threads and processes use the common time-out."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]
CLOCK = re.compile(r"\btime\.(monotonic|perf_counter|time)\(")
EXCEPTIONS = {"support/patience.py", "support/daemon_faults.py"}
"""Exempt files: the definition of the time-out, and a hostile client whose time-out is part of the test."""


def limits(tree: ast.AST) -> Iterator[int]:
    """Returns line numbers of waits with a number of seconds, and of asserted clock comparisons."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            given = [each.value for each in node.keywords if each.arg == "timeout"]
            given += node.args if ast.unparse(node.func).endswith((".settimeout", "asyncio.timeout")) else []
            if any(isinstance(each, ast.Constant) and each.value is not None for each in given):
                yield node.lineno
        elif isinstance(node, ast.Assert):
            compared = [each for each in ast.walk(node.test) if isinstance(each, ast.Compare)]
            ordered = [
                each for each in compared if isinstance(each.ops[0], ast.Lt | ast.LtE | ast.Gt | ast.GtE)
            ]
            if any(CLOCK.search(ast.unparse(each)) for each in ordered):
                yield node.lineno


def test_no_test_has_its_own_time_out():
    found = []
    for path in TESTS.rglob("*.py"):
        name = str(path.relative_to(TESTS))
        if name not in EXCEPTIONS:
            found += [f"{name}:{line}" for line in limits(ast.parse(path.read_text(encoding="utf-8")))]
    assert found == [], "wait with support.patience.until, or without a limit: pytest ends what hangs"


def test_the_check_finds_limits():
    text = """
subprocess.run(command, timeout=60)
process.communicate(timeout=5)
raw.settimeout(1.0)
assert time.monotonic() - begun < 10.0
httpx.Client(timeout=None)
axis.jog(token, 10.0, timeout_s=0.3)
"""
    assert sorted(limits(ast.parse(text))) == [2, 3, 4, 5]
