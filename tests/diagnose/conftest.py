"""The plant of this folder, and records of it that are short enough for a test."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from hdbridge.diagnose import Diagnosis, diagnose
from hdbridge.model import TransmissionModel
from hdbridge.record import Record


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("diagnose_plant", Path(__file__).with_name("plant.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def plant() -> ModuleType:
    return _load()


@pytest.fixture(scope="session")
def columns(plant: ModuleType) -> Callable[..., dict[str, Any]]:
    """Columns of a short bench plan on an axis with these effects."""

    def make(effects: dict[str, Any] | None = None, seed: int = 1, command: bool = True, **axis: Any) -> Any:
        plan = plant.Plan(rate_hz=16.0, scale=0.2, load_turns=1.05, steps=16)
        return plant.record(plant.Truth(effects=effects or {}, **axis), plan, seed, command)

    return make


@pytest.fixture(scope="session")
def model(plant: ModuleType) -> TransmissionModel:
    """The gear's model, some per cent off."""
    return TransmissionModel.from_text(plant.model_text(5))


@pytest.fixture(scope="session")
def diagnosed(columns: Callable[..., dict[str, Any]], model: TransmissionModel) -> Callable[..., Diagnosis]:
    def run(effects: dict[str, Any] | None = None, seed: int = 1, **axis: Any) -> Diagnosis:
        return diagnose(Record(columns(effects, seed, **axis)), model)

    return run
