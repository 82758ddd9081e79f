"""What the commands that measure by a plan share: where the record is kept, and how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hdbridge.cli.options import notes, progress_bar


@contextmanager
def kept_in(folder: Path) -> Iterator[None]:
    """Say where the record is when the measurement does not come to its end."""
    try:
        yield
    except BaseException:
        if (folder / "recording.yaml").exists():
            notes.print(f"what was measured is kept; go on with --resume {folder}", soft_wrap=True)
        raise


@contextmanager
def phases() -> Iterator[Callable[[str, float, float], None]]:
    """A progress bar for each phase: what is told of one total, in seconds, is one phase."""
    with progress_bar() as bar:
        bars: dict[float, int] = {}

        def show(name: str, done_s: float, total_s: float) -> None:
            if total_s not in bars:
                bars[total_s] = bar.add_task("", total=total_s)
            bar.update(bars[total_s], completed=done_s, description=f"{name:>18}")  # type: ignore[arg-type]

        yield show
