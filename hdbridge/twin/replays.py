"""Parallel replays in worker processes."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from copy import copy
from itertools import repeat
from typing import Any, Self

from hdbridge.effects import FloatArray
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import Data, Seed, coarse, residuals

WORTH_S = 2.0
"""Duration of the motion up to which replays run in this process, because starting workers costs more."""

_data: tuple[Data, Data] | None = None
"""A worker's recordings, and a few of their legs."""


class Replays:
    """Replays of the same recordings; a context manager that owns the worker processes."""

    rough: Replays
    """Replays of a few of their legs, in the same processes."""

    def __init__(self, data: Data, workers: int | None = None) -> None:
        self.data = data
        self._place = 0
        wanted = workers if workers is not None else min(os.cpu_count() or 1, 8)
        self._pool: ProcessPoolExecutor | None = None
        few = coarse(data)
        if wanted > 1 and data.duration_s > WORTH_S:
            # Not forked, because this process may have threads that hold locks.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(wanted, context, _begin, ((data, few),))
        rough = self.rough = copy(self)
        rough.data, rough.rough, rough._place = few, rough, 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def __call__(
        self, truths: Iterable[Truth], seeds: Iterable[Seed] = repeat(None)
    ) -> list[dict[str, FloatArray]]:
        """Returns the residuals of each truth, in order; ``seeds`` as in `misfit.traces_of`."""
        if self._pool is None or self.data.duration_s <= WORTH_S:
            return [residuals(self.data, each, seed) for each, seed in zip(truths, seeds, strict=False)]
        return list(self._pool.map(_residuals, truths, seeds, repeat(self._place)))

    def drawn(self, truths: Sequence[Truth]) -> list[dict[str, FloatArray]]:
        """Returns the residuals of each truth, in order, from rounded and noisy replays."""
        return self(truths, range(1, len(truths) + 1))


def _begin(data: tuple[Data, Data]) -> None:
    global _data  # noqa: PLW0603 - a process's own, set once where it begins
    _data = data
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends this process when its parent has been killed; it would otherwise wait for work forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # a worker has one
    parent.join()
    os._exit(1)


def _residuals(truth: Truth, seed: Seed, place: int) -> dict[str, FloatArray]:
    assert _data is not None
    return residuals(_data[place], truth, seed)
