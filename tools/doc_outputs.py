"""Writes what commands print into README.md, the tutorial and the twin's page: they show what happens today.

python tools/doc_outputs.py                rewrite all blocks: some minutes, three calibrations
python tools/doc_outputs.py --check        say which blocks have another text, or figures beyond the tolerance
... --cheap                                only what takes seconds, which is what the tests do

A block stands between `<!-- output: NAME -->` and `<!-- end -->`. The commands run in one new folder, in
the order of `STEPS`, as somebody would who follows the tutorial. Dates are replaced by fixed ones.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs" / "tutorial.md", ROOT / "docs" / "twin.md")
BLOCK = re.compile(r"(<!-- output: (?P<name>[a-z0-9-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
ABSOLUTE = 0.3
"""Arcsec by which a figure may differ: ten times the scatter of a 3 sigma of 240 steps at the floor."""
RELATIVE = 0.02
FIRST = datetime(2026, 1, 5, 13, 30, tzinfo=UTC)
APART = timedelta(minutes=31, seconds=38)
"""Between two dates of the pages."""


@dataclass(frozen=True, slots=True)
class Step:
    """A command of the pages. ``shell`` prepares it; ``shown`` is what its block begins with, after `$`."""

    name: str
    shell: str
    shown: str = ""
    rows: tuple[tuple[str, str], ...] = ((".", r"\Z."),)
    """Which lines stand in the block: from the first that matches to the next that does, several times."""
    cheap: bool = False
    status: int = 0
    fenced: bool = False


STEPS = (
    Step("demo", "hdbridge demo", rows=(("Load error", "quantisation"),), fenced=True),
    Step("check", "hdbridge check my-axis", "hdbridge check my-axis", cheap=True),
    Step(
        "check-typo",
        "cp -r my-axis typo && sed -i 's/ratio: 50/ratoi: 50/' typo/axis.yaml && mv my-axis kept && "
        "mv typo my-axis && { hdbridge check my-axis; code=$?; rm -r my-axis; mv kept my-axis; exit $code; }",
        cheap=True,
        status=2,
    ),
    Step(
        "scan",
        "hdbridge scan my-axis --simulate",
        "hdbridge scan my-axis --simulate",
        rows=(("the simulated bus", "device  "), ("modes", "identity:"), ("node 1 is", ".")),
        cheap=True,
    ),
    Step(
        "doctor",
        "hdbridge doctor my-axis --simulate",
        "hdbridge doctor my-axis --simulate",
        rows=(
            ("the files", "the node answers"),
            ("counts, dir", "counts, dir"),
            ("quick stop", "heartbeat lost"),
            ("^all ", "."),
        ),
        cheap=True,
    ),
    Step(
        "doctor-fails",
        "cp -r my-axis turned && "
        "sed -i '/^load_encoder/,/^[a-z]/s/direction: 1/direction: -1/' turned/axis.yaml && "
        "grep -q 'direction: -1' turned/axis.yaml && mv my-axis kept && mv turned my-axis && "
        "{ hdbridge doctor my-axis --simulate; code=$?; rm -r my-axis; mv kept my-axis; exit $code; }",
        rows=(("FAIL .*counts, dir", "->"),),
        cheap=True,
        status=4,
    ),
    Step(
        "calibrate",
        "hdbridge calibrate my-axis --simulate",
        rows=(("Model of", r"orders\[2\].amp"), ("hysteresis", "the new model is at")),
    ),
    Step("commit", "hdbridge model commit my-axis"),
    Step("log", "hdbridge model log my-axis", "hdbridge model log my-axis"),
    Step(
        "step",
        "hdbridge step my-axis --simulate --count 60",
        "hdbridge step my-axis --simulate --count 60",
        rows=(("^┏", "quantisation"),),
    ),
    Step(
        "again",
        "hdbridge calibrate my-axis --simulate --seed 1; rm -f my-axis/pending.yaml",
        rows=(("^(not offered|calibration demo)", "."),),
    ),
    Step(
        "worn",
        "sed 's/offset_arcsec: 31.5/offset_arcsec: 38/' my-axis/truth.yaml > worn.yaml && "
        "hdbridge calibrate my-axis --simulate --truth worn.yaml",
        rows=(("offset_arcsec", "."), ("Stepping test", "└")),
    ),
    Step(
        "log-after",
        "hdbridge model commit my-axis > /dev/null && "
        "hdbridge model rollback my-axis --reason 'the old gear is back' > /dev/null && "
        "hdbridge model log my-axis",
        "hdbridge model log my-axis",
    ),
    Step(
        "twin",
        "hdbridge new arm --from demo > /dev/null && "
        "hdbridge step arm --simulate --scheme none --count 4 --step-deg 150 --record steps > /dev/null && "
        "sed -i 's/coulomb_nm: 0.034/coulomb_nm: 0.06/; s/nm_per_rad: 15000/nm_per_rad: 9000/' "
        "arm/truth.yaml && hdbridge twin arm steps/stepping-none.csv.gz",
        rows=(("^friction", "hdbridge model"),),
    ),
)


def outputs(steps: Sequence[Step], folder: Path) -> Iterator[tuple[Step, str]]:
    """Each step with what it printed to standard output, or to standard error where it was refused."""
    shutil.copytree(ROOT / "profiles" / "demo", folder / "my-axis", dirs_exist_ok=True)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "COLUMNS": "80",
        "OPENBLAS_NUM_THREADS": "1",
    }
    for step in steps:
        done = subprocess.run(
            step.shell, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode != step.status:
            raise SystemExit(f"{step.name}: exit status {done.returncode}, not {step.status}\n{done.stderr}")
        yield step, done.stdout or done.stderr


def block(step: Step, text: str, dates: Mapping[str, str]) -> str:
    """The block of a page: the lines that the step shows, `...` for those left out."""
    for found, fixed in dates.items():
        text = text.replace(found, fixed)
    lines = [line.rstrip() for line in text.rstrip().splitlines()]
    shown = [f"$ {step.shown}"] if step.shown else []
    after = 0
    for number, (first, last) in enumerate(step.rows):
        start = next(i for i, line in enumerate(lines) if i >= after and re.search(first, line))
        if number and start > after:
            shown.append("...")
        beyond = next((i for i, line in enumerate(lines) if i >= start and re.search(last, line)), None)
        after = len(lines) if beyond is None else beyond + 1
        shown += lines[start:after]
    if step.fenced:
        return "\n".join(["", "```text", *shown, "```", "", ""])
    return "\n".join(["", *(f"    {line}".rstrip() for line in shown), "", ""])


def fixed_dates(text: str, known: Mapping[str, str]) -> dict[str, str]:
    """Every date in a text with the one that stands for it; the same date always with the same."""
    dates = dict(known)
    for found in re.findall(r"\d{8}-\d{6}|\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", text):
        if found not in dates:
            date = FIRST + len(dates) * APART
            dates[found] = f"{date:%Y%m%d-%H%M%S}" if "T" not in found else f"{date:%Y-%m-%dT%H:%M:%SZ}"
    return dates


def made(cheap: bool) -> dict[str, str]:
    """All blocks by name."""
    blocks: dict[str, str] = {}
    dates: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        steps = [step for step in STEPS if step.cheap or not cheap]
        for step, text in outputs(steps, Path(folder)):
            dates = fixed_dates(text, dates)
            blocks[step.name] = block(step, text, dates)
    return blocks


def on_pages() -> dict[str, str]:
    """The blocks as the pages have them."""
    return {
        found["name"]: found[0].split("\n", 1)[1].removesuffix("<!-- end -->")
        for page in PAGES
        for found in BLOCK.finditer(page.read_text(encoding="utf-8"))
    }


def differs(one: str, other: str) -> str | None:
    """How two outputs differ beyond the tolerance of their figures; None where they do not."""

    def words(text: str) -> list[str]:
        return re.sub(r"[\s━─]+", " ", NUMBER.sub("#", text)).split()

    if words(one) != words(other):
        return "another text"
    pairs: Sequence[tuple[str, str]] = [*zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)]
    apart = [
        f"{a} and {b}"
        for a, b in pairs
        if not math.isclose(float(a), float(b), rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    ]
    return ", ".join(apart) or None


def _filled(found: re.Match[str], blocks: Mapping[str, str]) -> str:
    new = blocks.get(found["name"])
    return found[0] if new is None else f"{found[1]}{new}{found[3]}"


def main() -> int:
    """Rewrite, or check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--cheap", action="store_true")
    asked = parser.parse_args()
    blocks = made(asked.cheap)
    if asked.check:
        shown = on_pages()
        wrong = {name: differs(shown[name], each) for name, each in blocks.items() if name in shown}
        for name, what in wrong.items():
            if what:
                print(f"{name}: {what}")
        return int(any(wrong.values()))
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        page.write_text(BLOCK.sub(lambda found: _filled(found, blocks), text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
