"""Tests of `hdbridge diagnose`, from input files to output files."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hdbridge.axis.model import TransmissionModel
from hdbridge.cli import app
from hdbridge.errors import InputError
from hdbridge.records.record import Record

RUN = CliRunner()


@pytest.fixture
def files(
    tmp_path: Path, columns: Callable[..., dict[str, Any]], model: TransmissionModel
) -> tuple[Path, Path]:
    hidden = {"motor_order": {"orders": [(5, 4.0, 30.0)]}}
    Record(columns(hidden)).write_csv(tmp_path / "record.csv.gz")
    model.save(tmp_path / "model.yaml")
    return tmp_path / "record.csv.gz", tmp_path / "model.yaml"


def test_writes_findings_and_an_extended_model(files: tuple[Path, Path], tmp_path: Path) -> None:
    out, new, page = (tmp_path / name for name in ("out.json", "new.yaml", "page.html"))
    command = ["diagnose", str(files[0]), "--model", str(files[1]), "--json", str(out), "--extend", str(new)]
    command += ["--html", str(page)]
    result = RUN.invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    data = json.loads(out.read_text())
    assert [each["cause"] for each in data["findings"]] == ["motor_order"]
    assert "motor_order" in [each.name for each in TransmissionModel.load(new).effects]
    assert "motor_order" in result.output
    sentence = data["record"]["sentence"]
    assert result.stdout.startswith(sentence)
    assert html.escape(sentence) in page.read_text()
    shares = {name: each["share_of_baseline"] for name, each in data["seen_over"].items()}
    assert max(shares, key=lambda name: shares[name]) == "motor angle"
    assert "motor angle" in result.output
    assert "Diagnosis of record.csv.gz" in page.read_text()
    # Output to a pipe is complete, and its tables fit 80 columns.
    tables = [line for line in result.output.splitlines() if line[:1] in "│┃┏└┡"]
    assert max(map(len, tables)) <= 80
    assert "…" not in result.output
    assert "order 5 amplitude" in result.output


@pytest.mark.parametrize(
    "options",
    [[], ["--model", "nowhere.yaml"], ["--plan", "nowhere"]],
    ids=["no model", "no file", "no plan"],
)
def test_bad_input_is_refused(options: list[str], files: tuple[Path, Path]) -> None:
    records = [] if "--plan" in options else [str(files[0])]
    options = [*options, "--model", str(files[1])] if "--plan" in options else options
    with pytest.raises(InputError):
        RUN.invoke(app, ["diagnose", *records, *options], catch_exceptions=False)


def test_a_plan_is_judged_before_anything_moves(files: tuple[Path, Path], tmp_path: Path) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        "schema: hdbridge.plan/1\nname: small\nprocedures:\n"
        "  - {procedure: standstill, duration_s: 5}\n"
        "  - {procedure: sweep, motor_turns: 6, motor_turns_per_s: 0.5}\n"
    )
    out = tmp_path / "plan.json"
    command = ["diagnose", "--plan", str(plan), "--model", str(files[1]), "--json", str(out)]
    result = RUN.invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.startswith("This plan has no torque at the load: ")
    found = json.loads(out.read_text())["identifiability"]
    assert found["motor_order"]["detectable"]
    # Six motor turns are an eighth of a load turn, over which these causes are not separable.
    assert set(found["load_order"]["aliases"]) & {"ratio_error", "compliance"}
