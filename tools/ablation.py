"""What each deciding number of the diagnosis is good for: each at its neutral value, on the same records.

python tools/ablation.py [--seed 1] [--records 40] [--only NAME ...] [--jobs 2] [--json FILE]

The records come from formulas that share no code with the effects (tests/support/plant.py): each cause alone,
two together, nothing under four elastic laws, and what the catalogue does not have. A number without which no
figure is worse is not needed for these records: it can go, unless other records are named that need it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parent))
from support import plant
from support.trials import CAUSES, drawn

from hdbridge.diagnose import diagnose
from hdbridge.estimation.scales import Scales
from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

PLAN = plant.Plan(rate_hz=16.0, scale=0.2, load_turns=1.05, steps=16)
"""Short: some 4,700 samples."""
LAWS = ("plain", "memory", "bouc_wen", "dahl")
UNKNOWN = ("saw", "square", "chirp", "one_way", "beat", "bursts")
SAME = {"motor_encoder_eccentricity": "motor_order"}
"""Causes that no record of one mounting of the encoder distinguishes."""
OF_THE_LOOP = {"hysteresis_memory", "hysteresis_parameters"}


@dataclass(frozen=True)
class Case:
    """A record to be made, and what is hidden in it."""

    name: str
    hidden: tuple[str, ...]
    effects: Mapping[str, Any]
    axis: Mapping[str, Any]
    seed: int

    @property
    def kind(self) -> str:
        """The row that it counts in."""
        return self.name.partition(":")[0]


def cases(seed: int, count: int) -> Iterator[Case]:
    """About ``count``: a half single causes, a fifth pairs, the rest empty, other laws and unknown."""
    rng = np.random.default_rng(seed)
    names = [CAUSES[i] for i in rng.permutation(len(CAUSES))]
    for number in range(count // 2):
        cause = names[number % len(names)]
        effects, axis = drawn(cause, rng)
        yield Case(f"single:{cause}:{number}", (cause,), effects, axis, seed * 1000 + number)
    for number in range(count // 5):
        one, other = (str(each) for each in rng.choice(CAUSES, 2, replace=False))
        (first, axis), (second, more) = drawn(one, rng), drawn(other, rng)
        hidden = {**first, **second}
        yield Case(f"pair:{one}+{other}", (one, other), hidden, {**axis, **more}, seed * 1000 + 300 + number)
    for number in range(count // 5):
        law = LAWS[number % len(LAWS)]
        own = ("hysteresis_memory",) if law == "memory" else ()
        kind = "none" if law in LAWS[:2] else "other_law"
        yield Case(f"{kind}:{law}:{number}", own, {}, {"law": law}, seed * 1000 + 500 + number)
    for number in range(count // 8):
        what = UNKNOWN[number % len(UNKNOWN)]
        effects = {"unknown": {"kind": what, "size": float(rng.uniform(2.5, 5.0))}}
        yield Case(f"unknown:{what}:{number}", (), effects, {}, seed * 1000 + 700 + number)


def answers(case: Case, variants: Sequence[Scales]) -> list[list[str]]:
    """The names that each variant gives, most important first."""
    record = Record(plant.record(plant.Truth(effects=dict(case.effects), **case.axis), PLAN, case.seed))
    model = TransmissionModel.from_text(plant.model_text(case.seed))
    return [[each.cause for each in diagnose(record, model, scales=one).findings] for one in variants]


def figures(judged: Sequence[tuple[Case, Sequence[str]]]) -> dict[str, int]:
    """Counts over the records: more is better, but for what begins with ``false`` or ``wrong``."""
    rows = dict.fromkeys(
        ("right_first", "wrong_first", "recalled", "wrong_names", "false_none", "false_other_law",
         "led_unknown", "false_unknown"), 0,
    )  # fmt: skip
    for case, names in judged:
        hidden = {SAME.get(each, each) for each in case.hidden}
        named = [SAME.get(each, each) for each in names]
        causes = [each for each in named if each != "unexplained"]
        if case.kind in {"single", "pair"}:
            rows["recalled"] += len(hidden & set(causes))
            rows["wrong_names"] += len(set(causes) - hidden)
            if case.kind == "single" and named:
                rows["right_first" if named[0] in hidden else "wrong_first"] += 1
        elif case.kind == "unknown":
            rows["led_unknown"] += bool(named) and named[0] == "unexplained"
            rows["false_unknown"] += bool(causes)
        else:
            allowed = hidden | (OF_THE_LOOP if case.kind == "other_law" else set())
            rows[f"false_{case.kind}"] += bool(set(causes) - allowed)
    return rows


def worse(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """The rows that lose, and by how much."""
    lost = {}
    for name, count in before.items():
        change = after[name] - count
        loss = change if name.startswith(("false", "wrong")) else -change
        if loss > 0:
            lost[name] = loss
    return lost


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, run every variant on every record, print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--only", nargs="*", default=[], help="names of scalars; default all")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    table = [each for each in fields(Scales) if "neutral" in each.metadata]
    chosen = [each for each in table if not options.only or each.name in options.only]
    variants = [Scales(), *(replace(Scales(), **{each.name: each.metadata["neutral"]}) for each in chosen)]
    given = list(cases(options.seed, options.records))
    with ProcessPoolExecutor(options.jobs) as pool:
        found = []
        for case, names in zip(given, pool.map(answers, given, [variants] * len(given)), strict=True):
            found.append(names)
            print(
                f"{len(found)}/{len(given)} {case.name}: {', '.join(names[0]) or 'nothing'}",
                file=sys.stderr,
                flush=True,
            )
    base = figures([(case, names[0]) for case, names in zip(given, found, strict=True)])
    print("as it is:", ", ".join(f"{name} {count}" for name, count in base.items()))
    result: dict[str, Any] = {"seed": options.seed, "records": len(given), "as_it_is": base, "scalars": {}}
    print("| scalar | value | neutral | answers that change | rows lost |\n|---|---|---|---|---|")
    for number, each in enumerate(chosen, 1):
        changed = sum(names[number] != names[0] for names in found)
        after = figures([(case, names[number]) for case, names in zip(given, found, strict=True)])
        lost = worse(base, after)
        words = ", ".join(f"{name} {count}" for name, count in lost.items()) or "none"
        value, neutral = getattr(Scales(), each.name), each.metadata["neutral"]
        print(f"| `{each.name}` | {value:g} | {neutral:g} | {changed} | {words} |")
        result["scalars"][each.name] = {"changed": changed, "lost": lost, "after": after}
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
