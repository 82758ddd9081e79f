"""Mutation testing of the pure modules: changes one operator or number at a time and runs the tests.

    make mutants
    .venv/bin/python tools/mutants.py --seed 1 --sample 60 --minutes 30 --only motion axis.effects

The modules are those of the import contract on the pure core (pyproject.toml). A random sample of all mutants
is drawn by seed. Each mutant replaces its module in a separate process, in which the tests run until one
fails; no file is changed. A mutant that takes three times the CPU time of the unchanged module counts as
killed. Prints each mutant when it is done, and finally, by package, the fraction killed with its 95 %
interval, and the survivors. `--minutes` limits the CPU time; the rest of the sample is then not run.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator
from proportions import proportion

ROOT = Path(__file__).resolve().parents[1]
CONTRACT = "The pure core does no input or output and looks at no clock"
TESTS = {
    "axis.effects": ("effects", "compensation"),
    "control": ("compensation",),
    "analysis": ("analysis", "identify", "diagnose"),
    "motion": ("motion", "procedures"),
    "commissioning.evaluation": ("report", "bench"),
    "drive": ("drive",),
    "daemon.following": ("daemon/following",),
}
"""Folders of tests, the fastest first, by the package of the mutant."""
BINARY = (("Add", "Sub"), ("Sub", "Add"), ("Mul", "Div"), ("Div", "Mul"), ("FloorDiv", "Div"), ("Pow", "Mul"))
COMPARED = (
    ("Lt", "LtE"), ("LtE", "Lt"), ("Gt", "GtE"), ("GtE", "Gt"), ("Lt", "GtE"), ("Gt", "LtE"), ("Eq", "NotEq"),
    ("NotEq", "Eq"), ("Is", "IsNot"), ("IsNot", "Is"),
)  # fmt: skip
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{old}_{new}" for old, new in BINARY),
    *(f"core/ReplaceComparisonOperator_{old}_{new}" for old, new in COMPARED),
    "core/ReplaceUnaryOperator_Delete_USub", "core/ReplaceUnaryOperator_Delete_Not", "core/AddNot",
    "core/ReplaceTrueWithFalse",
    "core/ReplaceFalseWithTrue", "core/ReplaceAndWithOr", "core/ReplaceOrWithAnd",
    "core/ReplaceBreakWithContinue", "core/ReplaceContinueWithBreak", "core/NumberReplacer",
)  # fmt: skip
SLOWER = 3.0
"""Ratio of a mutant's CPU time to that of the unchanged module, above which the mutant counts as killed."""
START_S = 10.0
"""Additional CPU time allowed for imports, s."""
EQUIVALENT = re.compile(r"\s*@|\s+[A-Z_]+ = \d+$")
"""Lines that are not mutated: decorators, and members of enumerations, whose values are arbitrary."""
PLUGINS = ("pytest_timeout", "_hypothesis_pytestplugin", "hdbridge.pytest_plugin")


@dataclass(frozen=True)
class Mutant:
    """One change of a module, given by its place and its operator."""

    path: str
    operator: str
    occurrence: int
    line: int

    @property
    def package(self) -> str:
        """Package of the mutant, a key of `TESTS`."""
        module = self.path.removeprefix("hdbridge/").removesuffix(".py").replace("/", ".")
        return next(each for each in TESTS if f"{module}.".startswith(f"{each}."))

    def source(self) -> str:
        """Returns the source of the changed module."""
        changed = mutate_code((ROOT / self.path).read_text(), get_operator(self.operator)(), self.occurrence)
        assert changed is not None
        return changed

    def __str__(self) -> str:
        lines = ((ROOT / self.path).read_text().splitlines(), self.source().splitlines())
        old, new = next((a, b) for a, b in zip(*lines, strict=True) if a != b)
        return f"{self.path}:{self.line}: {old.strip()} -> {new.strip()}"


def modules() -> Iterator[str]:
    """Yields the files of the pure modules."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (contract,) = (each for each in settings if each["name"] == CONTRACT)
    files = set()
    for name in contract["source_modules"]:
        path = ROOT / name.replace(".", "/")
        files |= set(path.rglob("*.py")) if path.is_dir() else {path.with_suffix(".py")}
    yield from sorted(str(each.relative_to(ROOT)) for each in files)


def mutants(path: str) -> Iterator[Mutant]:
    """Yields every mutant of a file, except in lines that match `EQUIVALENT`."""
    text = (ROOT / path).read_text()
    lines, nodes = text.splitlines(), list(ast_nodes(get_ast(text)))
    for name in OPERATORS:
        operator = get_operator(name)()
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        for occurrence, ((line, _), _) in enumerate(places):
            if not EQUIVALENT.match(lines[line - 1]):
                yield Mutant(path, name, occurrence, line)


def tests_of(mutant: Mutant) -> list[str]:
    """Returns the test files of the mutant's package; those that mention its module come first."""
    stem = Path(mutant.path).stem
    folders = [ROOT / "tests" / each for each in TESTS[mutant.package]]
    files = [each for folder in folders for each in sorted(folder.glob("test_*.py"))]
    return [str(each) for each in sorted(files, key=lambda each: stem not in each.read_text())]


def fails(path: str, source: str, tests: list[str], limit_s: float | None = None) -> tuple[bool, float]:
    """Runs tests with a changed source of a module; returns True if one failed, and the CPU time, s."""
    assert "hdbridge" not in sys.modules, "the new process must load the package itself"
    before_s = _children_s()
    if not (child := os.fork()):
        _run(str(ROOT / path), source, tests, limit_s)
    _, status = os.waitpid(child, 0)
    return status != 0, _children_s() - before_s


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _run(path: str, source: str, tests: list[str], limit_s: float | None) -> None:
    """Runs the tests in this child process, and ends it with their exit status."""
    plain = SourceFileLoader.get_code

    def get_code(self: SourceFileLoader, fullname: str) -> object:
        return compile(source, path, "exec") if self.path == path else plain(self, fullname)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign, assignment]
    sys.dont_write_bytecode = True
    quiet = os.open(os.devnull, os.O_RDWR)
    for each in (0, 1, 2):
        os.dup2(quiet, each)
    if limit_s is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 1))
    options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--disable-plugin-autoload"]
    options += [word for each in PLUGINS for word in ("-p", each)]
    os._exit(int(pytest.main([*options, *tests])))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sample", type=int, default=100, help="number of mutants")
    parser.add_argument("--minutes", type=float, default=60.0, help="limit of the processor time")
    parser.add_argument("--only", nargs="*", choices=list(TESTS), default=list(TESTS), help="packages")
    parser.add_argument("--json", type=Path, help="the mutants and what became of them")
    options = parser.parse_args()
    os.chdir(ROOT)
    every = [each for path in modules() for each in mutants(path) if each.package in options.only]
    sample = random.Random(options.seed).sample(every, min(options.sample, len(every)))
    sample.sort(key=lambda each: list(TESTS).index(each.package))
    print(
        f"{len(sample)} of {len(every)} mutants of {len({each.path for each in every})} modules", flush=True
    )
    limits: dict[str, float] = {}
    killed: dict[Mutant, bool] = {}
    for each in sample:
        if _children_s() > 60.0 * options.minutes:
            break
        tests = tests_of(each)
        if each.package not in limits:
            broken, took_s = fails(each.path, (ROOT / each.path).read_text(), tests)
            if broken:
                raise SystemExit(f"tests of {each.package} fail without a mutant")
            limits[each.package] = SLOWER * took_s + START_S
            print(f"{each.package}: its tests take {took_s:.0f} s of the processor", flush=True)
        killed[each], took_s = fails(each.path, each.source(), tests, limits[each.package])
        print(f"{'killed' if killed[each] else 'SURVIVED'} {took_s:.0f} s {each}", flush=True)
        if options.json:
            rows = [{**asdict(each), "killed": dead} for each, dead in killed.items()]
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    by_package: dict[str, list[bool]] = defaultdict(list)
    for each, dead in killed.items():
        by_package[each.package].append(dead)
        by_package["all"].append(dead)
    for name, dead in by_package.items():
        print(f"{name}: killed {proportion(sum(dead), len(dead))}")
    print(*(f"survived: {each}" for each, dead in killed.items() if not dead), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
