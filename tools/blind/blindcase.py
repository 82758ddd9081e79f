"""One blind case: what is hidden in it, drawn by its name and the suite's seed, and its folder."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from blindaxis import OTHER_LAWS, BlindAxis, drawn_axis
from blindbench import Bench, drawn_plan, run_of
from support.hidden import CAUSES, UNKNOWN, Hidden, Run, hide_all
from support.hidden.site import ARCSEC_PER_RAD

from hdbridge.sim.exercise import Readings
from hdbridge.sim.truth import Truth

KINDS = ("single", "power", "pair", "triple", "none", "other_law", "unknown", "no_torque")
POWER_RATIOS = (0.3, 1.0, 3.0, 10.0)
TORQUE_CAUSES = ("compliance", "load_order")
NEED_ROLLING = ("hysteresis_memory", "hysteresis_parameters")

# Structural look-alikes, by physics: whatever is measured at one axis without touching it, they read alike.
# A diagnosis that names one of them and gives the other as an alias is right.
TWINS = (
    ("motor_order", "motor_encoder_eccentricity"),
    ("load_order", "compliance"),
    ("ratio_error", "wear"),
    ("channel_skew", "velocity_windup"),
)


@dataclass(frozen=True)
class Case:
    """A case to be made: its folder's name says what it is."""

    name: str
    kind: str
    causes: tuple[str, ...]
    over_noise: float | None = None
    """Size over the noise of a reading; None: drawn, at least three times and 3 arcsec."""


def cases(wanted: dict[str, int], seed: int) -> Iterator[Case]:
    """The cases of a suite; ``wanted`` is a number by kind. Single and power count for each cause."""
    rng = random.Random(f"cases {seed}")
    for kind, number in wanted.items():
        if kind not in KINDS:
            raise ValueError(f"--cases: found '{kind}'; expected kinds of {', '.join(KINDS)}")
        if kind in ("single", "power"):
            ratios: tuple[float | None, ...] = (None,) if kind == "single" else POWER_RATIOS
            for cause, ratio, index in itertools.product(CAUSES, ratios, range(number)):
                tail = f"-{ratio:g}" if ratio else ""
                yield Case(f"{kind}-{cause}{tail}-{index}", kind, (cause,), ratio)
            continue
        for index in range(number):
            causes: tuple[str, ...] = ()
            if kind in ("pair", "triple"):
                causes = _together(rng, 2 if kind == "pair" else 3)
            elif kind == "unknown":
                causes = (sorted(UNKNOWN)[index % len(UNKNOWN)],)
            elif kind == "no_torque":
                causes = (TORQUE_CAUSES[index % len(TORQUE_CAUSES)],)
            yield Case(f"{kind}-{index:03d}", kind, causes)


def _together(rng: random.Random, number: int) -> tuple[str, ...]:
    """Causes that can be distinguished at all when they come together."""
    while True:
        causes = tuple(rng.sample(sorted(CAUSES), number))
        apart = all(not set(twins) <= set(causes) for twins in TWINS)
        if apart and not set(NEED_ROLLING) <= set(causes):
            return causes


def make(case: Case, seed: int, folder: Path, means: bool = False) -> Path:
    """Draw, run and write a case: record.csv, model.yaml, hidden.yaml and truth.yaml; its folder."""
    rng = random.Random(f"blind {seed} {case.name}")
    law = rng.choice(OTHER_LAWS) if case.kind == "other_law" else "rolling_friction"
    axis = drawn_axis(rng, f"blind-{case.name}", law)
    plan = drawn_plan(rng, axis.truth.gear.ratio)
    run = run_of(plan, axis.truth)
    sizes = [(cause, _size_arcsec(rng, cause, case.over_noise, axis.noise_arcsec)) for cause in case.causes]
    truth, hidden = hide_all(axis.truth, sizes, rng, run)
    readings = Bench(truth, rng.randrange(2**31), plan, means).record()
    columns = _columns(readings, rng, with_torque=case.kind != "no_torque")
    target = folder / case.name
    target.mkdir(parents=True, exist_ok=True)
    write_csv(target / "record.csv", columns)
    (target / "model.yaml").write_text(axis.model_yaml, encoding="utf-8")
    _write_yaml(target / "hidden.yaml", description(case, axis, truth, hidden, run, len(readings.time_s)))
    _write_yaml(target / "truth.yaml", truth.model_dump(mode="json", by_alias=True, exclude_defaults=True))
    return target


def _size_arcsec(rng: random.Random, cause: str, over_noise: float | None, noise_arcsec: float) -> float:
    if over_noise is not None:
        return over_noise * noise_arcsec
    size = max(3.0, 3.0 * noise_arcsec) * math.exp(rng.uniform(0.0, math.log(2.0)))
    return size / 3.0 if cause == "subdivisional_error" else size


def description(
    case: Case, axis: BlindAxis, truth: Truth, hidden: list[Hidden], run: Run, samples: int
) -> dict[str, Any]:
    """What hidden.yaml says."""
    brought = sorted({cause for each in hidden for cause in each.brings} - {each.cause for each in hidden})
    return {
        "schema": "hdbridge.blind/1",
        "case": case.name,
        "kind": case.kind,
        "over_noise": case.over_noise,
        "law": axis.law,
        "noise_arcsec": round(axis.noise_arcsec, 4),
        "samples": samples,
        "ratio": axis.truth.gear.ratio,
        "hidden": [
            {
                "cause": each.cause,
                "size_arcsec": round(each.size_arcsec, 4),
                "size_is": each.size_is,
                "text": each.text,
                "twins": sorted(_twins(each.cause)),
                "parameters": {key: float(value) for key, value in each.parameters.items()},
            }
            for each in hidden
        ],
        # Really there, though not hidden on purpose: to name them is neither right nor wrong.
        "also": [*brought, *_always(truth, run, axis, hidden)],
    }


def _twins(cause: str) -> set[str]:
    return {other for twins in TWINS if cause in twins for other in twins} - {cause}


def _always(truth: Truth, run: Run, axis: BlindAxis, hidden: list[Hidden]) -> list[str]:
    """Causes that the axis has of itself, large enough to be seen."""
    acceleration = run.load_acceleration_deg_s2 * 3600.0
    spring = truth.gear.stiffness_nm_per_rad / truth.load_.whole_inertia_kg_m2
    causes = {"inertial_windup"} if acceleration / spring > 0.2 * max(axis.noise_arcsec, 0.5) else set()
    if axis.law != "rolling_friction":
        # Another law than the model's is to be called just that.
        causes |= {"hysteresis_memory", "hysteresis_parameters"}
    if truth.load_.coulomb_nm:
        wind_up = truth.load_.coulomb_nm / truth.gear.stiffness_nm_per_rad * ARCSEC_PER_RAD
        if wind_up > 0.3 * max(axis.noise_arcsec, 0.5):
            causes |= {"velocity_windup", "backlash"}
    return sorted(causes - {each.cause for each in hidden})


def _columns(readings: Readings, rng: random.Random, with_torque: bool) -> dict[str, tuple[Any, str]]:
    """Columns of the record with their formats; the slow channels have their own noise and steps."""
    noise = np.random.default_rng(rng.randrange(2**31))
    samples = len(readings.time_s)
    torque = np.round(readings.load_torque_nm + noise.normal(0.0, 0.02, samples), 2)
    warmth = np.round((readings.temperature_c + noise.normal(0.0, 0.03, samples)) / 0.0625) * 0.0625
    columns: dict[str, tuple[Any, str]] = {
        "time_s": (readings.time_s, "%.3f"),
        "motor_position_deg": (readings.motor_deg, "%.6f"),
        "load_position_deg": (readings.load_deg, "%.8f"),
        "motor_target_deg": (readings.target_deg, "%.6f"),
        "load_torque_nm": (torque, "%.2f"),
        "motor_torque_nm": (readings.motor_torque_nm, "%.4f"),
        "temperature_c": (warmth, "%.4f"),
    }
    if not with_torque:
        del columns["load_torque_nm"]
    return columns


def write_csv(path: Path, columns: dict[str, tuple[Any, str]]) -> None:
    """A record as bare CSV."""
    table = np.column_stack([values for values, _ in columns.values()])
    formats = [each for _, each in columns.values()]
    np.savetxt(path, table, fmt=formats, delimiter=",", header=",".join(columns), comments="")


def _write_yaml(path: Path, data: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(data, sort_keys=False, width=110), encoding="utf-8")
