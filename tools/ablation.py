"""Ablation of the diagnosis: sets each deciding number to its neutral value, on the same records.

python tools/ablation.py [--seed 1] [--records 40] [--only NAME ...] [--kinds KIND ...] [--jobs 2] [--json F]

The records come from formulas that share no code with the effects (tests/support/plant.py): each cause alone,
also near the noise, two together, none under four elastic laws, and causes outside the catalogue. A number is
not needed for these records if no figure is worse without it: it can be removed, unless other records are
known that need it.

A record is diagnosed again only with the numbers on which a comparison depends in it (tools/whatif.py): first
with all of them neutral, and if that changes the answer, with one half and the other, down to single ones.
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
from support.trials import CAUSES, LOOPS, drawn, times
from whatif import WhatIf

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.scales import Scales
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

PLAN = plant.Plan(rate_hz=14.0, scale=0.2, load_turns=1.05, steps=14)
"""Short plan: some 13,000 samples, a diagnosis of 2 to 10 s."""
LAWS = ("plain", "memory", "changed", "bouc_wen", "dahl")
UNKNOWN = ("saw", "square", "chirp", "one_way", "beat", "bursts")
SAME = {"motor_encoder_eccentricity": "motor_order"}
"""Causes that a record with one mounting of the encoder does not distinguish."""
Answer = list[str]


@dataclass(frozen=True)
class Case:
    """Recipe of a record, with its hidden causes."""

    name: str
    hidden: tuple[str, ...]
    effects: Mapping[str, Any]
    axis: Mapping[str, Any]
    seed: int

    @property
    def kind(self) -> str:
        """Row of the table in which it counts."""
        return self.name.partition(":")[0]


def cases(seed: int, count: int) -> Iterator[Case]:
    """Yields about ``count`` cases: two fifths single causes, an eighth of them small, a quarter two or three
    at once, the rest empty, other laws and unknown.
    """
    rng = np.random.default_rng(seed)
    names = [CAUSES[i] for i in rng.permutation(len(CAUSES))]

    def together(chosen: Sequence[str], least: float, most: float) -> tuple[dict[str, Any], dict[str, Any]]:
        effects, axis = {}, {}
        for each in chosen:
            one, needs = drawn(each, rng)
            effects |= one
            axis |= needs
        return times(effects, float(rng.uniform(least, most))), axis

    def numbered(number: int, *rest: Any) -> Case:
        return Case(*rest, seed=seed * 1000 + number)

    number = 0
    for _ in range(2 * count // 5):
        cause = names[number % len(names)]
        yield numbered(number, f"single:{cause}", (cause,), *together([cause], 0.5, 1.0))
        number += 1
    for _ in range(count // 8):
        cause = names[number % len(names)]
        yield numbered(number, f"single:{cause} small", (cause,), *together([cause], 0.2, 0.4))
        number += 1
    for at in range(count // 4):
        several = tuple(str(each) for each in rng.choice(CAUSES, 3 if at % 4 == 3 else 2, replace=False))
        yield numbered(number, f"pair:{'+'.join(several)}", several, *together(several, 0.5, 1.0))
        number += 1
    for at in range(count // 8):
        law = LAWS[at % len(LAWS)]
        if law == "changed":
            axis = {"offset": 40.0 * float(rng.choice([0.8, 1.22])), "width": float(rng.uniform(18.0, 24.0))}
            yield numbered(number, "single:hysteresis_parameters", ("hysteresis_parameters",), {}, axis)
        else:
            own = ("hysteresis_memory",) if law == "memory" else ()
            kind = "none" if law in LAWS[:2] else "other_law"
            yield numbered(number, f"{kind}:{law}", own, {}, {"law": law})
        number += 1
    for at in range(count // 8):
        what = UNKNOWN[at % len(UNKNOWN)]
        effects = {"unknown": {"kind": what, "size": float(rng.uniform(1.5, 6.0))}}
        yield numbered(number, f"unknown:{what}", (), effects, {})
        number += 1


def walked(case: Case, chosen: Mapping[str, float]) -> tuple[Answer, dict[str, Answer], int]:
    """Returns the causes reported with all numbers, the different answers without a number (by that number),
    and how many numbers a comparison depends on.
    """
    record = Record(plant.record(plant.Truth(effects=dict(case.effects), **case.axis), PLAN, case.seed))
    model = TransmissionModel.from_text(plant.model_text(case.seed))

    def answer(scales: Scales) -> Answer:
        return [each.cause for each in diagnose(record, model, scales=scales).findings]

    differing: set[str] = set()
    both = {
        name: WhatIf(getattr(Scales(), name), {name: neutral}, differing) for name, neutral in chosen.items()
    }
    as_it_is = answer(replace(Scales(), **both))
    others: dict[str, Answer] = {}
    groups = [sorted(differing)]
    while groups:
        group = groups.pop()
        if not group:
            continue
        names = answer(replace(Scales(), **{name: chosen[name] for name in group}))
        if names == as_it_is:
            continue
        if len(group) == 1:
            others[group[0]] = names
        half = len(group) // 2
        groups += [group[:half], group[half:]] if half else []
    return as_it_is, others, len(differing)


def figures(judged: Sequence[tuple[Case, Sequence[str]]]) -> dict[str, int]:
    """Returns counts over the records; more is better, except for names with ``false`` or ``wrong``."""
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
            allowed = hidden | (LOOPS if case.kind == "other_law" else set())
            rows[f"false_{case.kind}"] += bool(set(causes) - allowed)
    return rows


def worse(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """Returns the loss of each row that is worse."""
    lost = {}
    for name, count in before.items():
        change = after[name] - count
        loss = change if name.startswith(("false", "wrong")) else -change
        if loss > 0:
            lost[name] = loss
    return lost


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, analyses every record, and prints a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--only", nargs="*", default=[], help="names of numbers; default all")
    parser.add_argument("--kinds", nargs="*", default=[], help="single, pair, none, ... ; default all")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    neutral = {
        each.name: float(each.metadata["neutral"])
        for each in fields(Scales)
        if each.metadata["neutral"] != getattr(Scales(), each.name)
        and (not options.only or each.name in options.only)
    }
    given = [
        each
        for each in cases(options.seed, options.records)
        if not options.kinds or each.kind in options.kinds
    ]
    found = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for case, walk in zip(given, pool.map(walked, given, [neutral] * len(given)), strict=True):
            found.append(walk)
            changing = "".join(f"; without {name}: {', '.join(names)}" for name, names in walk[1].items())
            words = f"{case.name}: {', '.join(walk[0]) or 'nothing'} ({walk[2]}){changing}"
            print(words, file=sys.stderr, flush=True)
    base = figures([(case, names) for case, (names, *_) in zip(given, found, strict=True)])
    print("as it is:", ", ".join(f"{name} {count}" for name, count in base.items()))
    result: dict[str, Any] = {"seed": options.seed, "records": len(given), "as_it_is": base, "scalars": {}}
    print("| number | value | unit | source | neutral | answers that change | rows lost |")
    print("|---|---|---|---|---|---|---|")
    described = Scales().described()
    for name, without in neutral.items():
        answers = [others.get(name, names) for names, others, _ in found]
        changed = sum(name in others for _, others, _ in found)
        after = figures(list(zip(given, answers, strict=True)))
        lost = worse(base, after)
        words = ", ".join(f"{row} {count}" for row, count in lost.items()) or "none"
        own = described[name]
        said = f"{own['value']:g} | {own['unit']} | {own['source']}"
        print(f"| `{name}` | {said} | {without:g} | {changed} | {words} |")
        result["scalars"][name] = {"changed": changed, "lost": lost, "after": after}
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
