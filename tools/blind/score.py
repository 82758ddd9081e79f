"""Diagnoses every case of a blind suite and prints the rates.

    python tools/blind/score.py build/blind             # rates
    python tools/blind/score.py build/blind --cases     # and cases, of a development suite (seed below 1000)
    python tools/blind/score.py build/blind --answers build/before --command 'OTHER/bin/hdbridge diagnose'

Each case is diagnosed once by the command, in a process of its own. The answers are kept in a folder and
judged again without running. Remove the folder, or name another, after a change of the code. An incomplete
suite can be scored so far. If a case of a hidden cause is given a name, the fresh record of the
same plant is diagnosed too, with the given and with the written model. Exit status 1 if a command failed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))
from blind.case import HELD_OUT_FROM, record_of, unsealed
from blind.tables import page
from blind.verdict import NAMED_ABOVE, UNEXPLAINED, Answer, Verdict, judged

COMMAND = f"{Path(sys.executable).parent / 'hdbridge'} diagnose"
BAD_INPUT = 2


def diagnosed(case: Path, answers: Path, command: Sequence[str], timeout_s: float) -> None:
    """Runs the command on a case; stores its answer atomically."""
    target = answers / case.name
    draft = answers / f".{case.name}.part"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)

    def run(record: str, model: Path, name: str, *options: str) -> dict[str, Any]:
        files = map(str, record_of(case, record))
        parts = [*command, *files, "--model", str(model), "--json", str(draft / name), *options]
        began_s = time.perf_counter()
        try:
            done = subprocess.run(parts, capture_output=True, text=True, timeout=timeout_s, check=False)
            status, said = done.returncode, (done.stderr or done.stdout)[-2000:]
        except subprocess.TimeoutExpired:
            status, said = 124, f"took more than {timeout_s:g} s"
        seconds = round(time.perf_counter() - began_s, 2)
        return {"exit_status": status, "seconds": seconds, **({"said": said} if status else {})}

    extended = draft / "extended.yaml"
    report = run("record", case / "model.yaml", "diagnosis.json", "--extend", str(extended))
    diagnosis = _json(draft / "diagnosis.json") or {}
    names = [each for each in diagnosis.get("findings", ()) if each["cause"] != UNEXPLAINED]
    if record_of(case, "fresh") and extended.exists() and any(n["probability"] > NAMED_ABOVE for n in names):
        run("fresh", case / "model.yaml", "fresh-given.json")
        run("fresh", extended, "fresh-extended.json")
    (draft / "answer.json").write_text(json.dumps(report), encoding="utf-8")
    draft.rename(target)


def verdict_of(case: Path, answers: Path) -> Verdict:
    """Evaluates the stored answer."""
    kept = answers / case.name
    report = _json(kept / "answer.json") or {}
    status = report["exit_status"]
    diagnosis = _json(kept / "diagnosis.json")
    failed = f"exit status {status}" if status not in {0, BAD_INPUT} else ""
    if status == 0 and (diagnosis or {}).get("schema") != "hdbridge.diagnosis/1":
        diagnosis, failed = None, "another schema"
    answer = Answer(
        diagnosis,
        _yaml(kept / "extended.yaml"),
        _json(kept / "fresh-given.json"),
        _json(kept / "fresh-extended.json"),
        refused=status == BAD_INPUT,
        failed=failed,
        seconds=report["seconds"],
    )
    return judged(unsealed(case), answer, _yaml(case / "model.yaml"))


def _json(path: Path) -> dict[str, Any] | None:
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else None


def _yaml(path: Path) -> dict[str, Any] | None:
    return dict(yaml.safe_load(path.read_text(encoding="utf-8"))) if path.exists() else None


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, diagnoses, evaluates and prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder that generate.py made")
    parser.add_argument("--answers", type=Path, help="folder of the answers; by default FOLDER/answers")
    parser.add_argument("--cases", action="store_true", help="list what went wrong, of a development suite")
    parser.add_argument("--jobs", type=int, default=1, help="cases at once; with 1 the run times are true")
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds for a case")
    parser.add_argument("--command", default=COMMAND, help="command that diagnoses")
    parser.add_argument("--only", default="", help="only cases whose folder's name contains this")
    options = parser.parse_args(arguments)
    seed = (_json(options.folder / "suite.json") or {}).get("seed")
    cases = sorted(
        each.parent for each in options.folder.glob("[!.]*/sealed.json") if options.only in each.parent.name
    )
    if seed is None or not cases:
        print(f"{options.folder}: no cases; make some with tools/blind/generate.py", file=sys.stderr)
        return 2
    if options.cases and seed >= HELD_OUT_FROM:
        print(
            f"--cases: the suite of seed {seed} is held out; make one with a seed below {HELD_OUT_FROM}",
            file=sys.stderr,
        )
        return 2
    answers = options.answers or options.folder / "answers"
    to_run = [each for each in cases if not (answers / each.name).exists()]
    command = shlex.split(options.command)
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = pool.map(lambda case: diagnosed(case, answers, command, options.timeout), to_run)
        for number, _ in enumerate(jobs, 1):
            print(f"\r{number} of {len(to_run)} diagnosed", end="", file=sys.stderr, flush=True)
    verdicts = [verdict_of(each, answers) for each in cases]
    print(page(verdicts, seed, options.cases))
    return 1 if any(each.failed for each in verdicts) else 0


if __name__ == "__main__":
    raise SystemExit(main())
