"""Records with something hidden, drawn from formulas that share no code with the effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from support import plant
from support.trials import CAUSES, LOOPS, SPECIAL, drawn, times

from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

PLAN = plant.Plan(rate_hz=14.0, scale=0.2, load_turns=1.05, steps=14)
"""As in tools/ablation.py: some 13,000 samples."""
KINDS = ("single", "small", "pair", "triple", "none", "other_law", "unknown", "noisy", "no_command")
UNKNOWN = ("saw", "square", "chirp", "one_way", "beat", "bursts")


@dataclass(frozen=True, slots=True)
class Drawn:
    """A record to be made, and what is hidden in it."""

    kind: str
    seed: int
    name: str
    hidden: frozenset[str]
    """Names of the causes."""
    allowed: frozenset[str]
    """Names that are not wrong."""
    truth: plant.Truth
    command: bool = True

    def made(self) -> tuple[Record, TransmissionModel]:
        """The record, and the model that is put to the test."""
        columns = plant.record(self.truth, PLAN, self.seed, self.command)
        return Record(columns), TransmissionModel.from_text(plant.model_text(self.seed))


def draw(kind: str, seed: int) -> Drawn:
    """What one seed gives of one kind of record."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "unknown":
        what = str(rng.choice(UNKNOWN))
        effects = {"unknown": {"kind": what, "size": float(rng.uniform(1.5, 6.0))}}
        return Drawn(kind, seed, what, frozenset(), frozenset(), plant.Truth(effects=effects))
    if kind in {"none", "other_law"}:
        law = str(rng.choice(["plain", "bouc_wen", "dahl"][kind == "other_law" :][: 2 - (kind == "none")]))
        return Drawn(
            kind,
            seed,
            law,
            frozenset(),
            frozenset(LOOPS if kind == "other_law" else ()),
            plant.Truth(law=law),
        )
    count = {"pair": 2, "triple": 3}.get(kind, 1)
    causes = [
        str(each) for each in rng.choice([*CAUSES, *SPECIAL] if count == 1 else CAUSES, count, replace=False)
    ]
    least, most = (0.2, 0.4) if kind == "small" else (0.5, 1.0)
    effects, axis = {}, {}
    for cause in causes:
        if cause in SPECIAL:
            axis |= _loop(cause, rng)
        else:
            one, needs = drawn(cause, rng)
            effects |= one
            axis |= needs
    truth = plant.Truth(effects=times(effects, float(rng.uniform(least, most))), **axis)
    if kind == "noisy":
        truth = replace(truth, noise=truth.noise * float(np.exp(rng.uniform(np.log(0.5), np.log(10.0)))))
    return Drawn(
        kind, seed, "+".join(causes), frozenset(causes), frozenset(causes), truth, kind != "no_command"
    )


def _loop(cause: str, rng: np.random.Generator) -> dict[str, Any]:
    if cause == "hysteresis_memory":
        return {"law": "memory"}
    return {"offset": 40 * float(rng.choice([0.82, 1.2])), "width": 20 * float(rng.uniform(0.9, 1.2))}
