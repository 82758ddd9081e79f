"""The search by evidence: its formulas against dense ones, and a hidden cause that it names."""

from __future__ import annotations

import numpy as np
from evidence.draw import draw
from evidence.gaussian import Moments, posterior
from evidence.noise import Noise
from evidence.posterior import explained
from support import plant

from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

QUICK = plant.Plan(rate_hz=14.0, scale=0.05, load_turns=0.25, steps=4)


def _record(count: int = 150) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.05, 0.4, count))
    sigma = rng.uniform(0.2, 0.5, count)
    columns = rng.normal(size=(count, 7))
    return rng.normal(size=count) + columns[:, 0], columns, sigma, time_s


def _moments(y: np.ndarray, columns: np.ndarray, noise: Noise) -> Moments:
    solved = noise.solve(columns)
    constant = -0.5 * (noise.log_determinant + len(y) * np.log(2.0 * np.pi))
    return Moments(columns.T @ solved, solved.T @ y, float(y @ noise.solve(y)), constant)


def _dense(
    y: np.ndarray,
    columns: np.ndarray,
    sigma: np.ndarray,
    time_s: np.ndarray,
    mean: np.ndarray,
    wide: np.ndarray,
) -> float:
    apart = np.abs(np.subtract.outer(time_s, time_s))
    covariance = np.diag(sigma**2) + 0.4**2 * np.exp(-apart / 3.0) + (columns * wide**2) @ columns.T
    off = y - columns @ mean
    size = np.linalg.slogdet(2.0 * np.pi * covariance).logabsdet
    return float(-0.5 * (off @ np.linalg.solve(covariance, off) + size))


def test_the_log_evidence_is_that_of_the_dense_gaussian() -> None:
    y, columns, sigma, time_s = _record()
    mean, wide = np.linspace(-0.5, 1.0, 7), np.geomspace(0.1, 5.0, 7)
    found = posterior(_moments(y, columns, Noise(sigma, time_s, (0.4, 3.0))), mean, wide)
    assert abs(found.log_evidence - _dense(y, columns, sigma, time_s, mean, wide)) < 1e-6


def test_what_a_group_of_columns_gains_is_the_difference_of_two_evidences() -> None:
    y, columns, sigma, time_s = _record()
    noise = Noise(sigma, time_s, (0.4, 3.0))
    few, more = columns[:, :4], columns[:, 4:]
    before = posterior(_moments(y, few, noise), np.zeros(4), np.ones(4))
    solved = noise.solve(more)
    gain = before.gain(few.T @ solved, more.T @ solved, solved.T @ y)
    with_all = _dense(y, columns, sigma, time_s, np.zeros(7), np.ones(7))
    assert abs(gain - (with_all - _dense(y, few, sigma, time_s, np.zeros(4), np.ones(4)))) < 1e-6


def test_a_hidden_cause_is_named_and_nothing_else() -> None:
    truth = plant.Truth(effects={"zero_drift": {"size": 4.0, "tau": 0.2}})
    record = Record(plant.record(truth, QUICK, 11))
    found = explained(record, TransmissionModel.from_text(plant.model_text(11)))
    assert [each.cause for each in found.findings] == ["zero_drift"]
    assert found.findings[0].probability > 0.95


def test_a_seed_gives_the_same_record_every_time() -> None:
    one, other = draw("pair", 5), draw("pair", 5)
    assert one.hidden == other.hidden
    assert len(one.hidden) == 2
    assert one.truth == other.truth
