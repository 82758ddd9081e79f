"""Fixtures of this folder: the plant, and records of it that are short enough for a test."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import support.plant

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record


@pytest.fixture(scope="session")
def plant() -> ModuleType:
    return support.plant


@pytest.fixture(scope="session")
def columns(plant: ModuleType) -> Callable[..., dict[str, Any]]:
    """Returns a function that records an axis with given effects on a short bench plan, as columns."""

    def make(
        effects: dict[str, Any] | None = None,
        seed: int = 1,
        command: bool = True,
        rate_hz: float = 12.0,
        **axis: Any,
    ) -> Any:
        plan = plant.Plan(rate_hz=rate_hz, scale=0.2, load_turns=1.05, steps=16)
        return plant.record(plant.Truth(effects=effects or {}, **axis), plan, seed, command)

    return make


@pytest.fixture(scope="session")
def model(plant: ModuleType) -> TransmissionModel:
    """Returns a model of the gear whose parameters are a few per cent off."""
    return TransmissionModel.from_text(plant.model_text(5))


@pytest.fixture(scope="session")
def diagnosed(columns: Callable[..., dict[str, Any]], model: TransmissionModel) -> Callable[..., Diagnosis]:
    known: dict[str, Diagnosis] = {}

    def run(effects: dict[str, Any] | None = None, seed: int = 1, **axis: Any) -> Diagnosis:
        key = repr((effects or {}, seed, axis))
        if key not in known:  # no record is diagnosed twice
            known[key] = diagnose(Record(columns(effects, seed, **axis)), model)
        return known[key]

    return run
