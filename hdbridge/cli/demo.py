"""``hdbridge demo``: the whole workflow on a simulated axis, in one command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import say, write_json
from hdbridge.cli.session import Session
from hdbridge.files.atomic import make_folder, new_folder
from hdbridge.files.outputs import Kind

if TYPE_CHECKING:
    from hdbridge.commissioning.evaluation.comparison import Comparison


def command(
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Where the results go; else demo-output, numbered."),
        Kind.FOLDER,
    ] = None,
    count: Annotated[int, typer.Option("--count", min=2, max=2000, help="Steps each way.")] = 240,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the simulated axis.")] = 0,
) -> None:
    """Step a simulated axis 240 times each way under four compensation schemes.

    Table, JSON, records and a page go to FOLDER.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.cli.step import print_result, run_comparison, write_page
    from hdbridge.motion.procedures.stepping import Stepping

    session = Session("article", simulate=True, seed=seed)
    files, axis = session.files, session.axis
    stepping = Stepping(count=count)
    folder = new_folder(Path("demo-output")) if out is None else make_folder(out)

    def tell(comparison: Comparison) -> None:
        write_json(folder / "stepping.json", comparison.as_dict())
        write_page(folder / "stepping.html", axis, files.model, comparison, stepping, seed)
        print_result(axis, comparison)

    run_comparison(
        session,
        TransmissionModel.load(files.model),
        stepping,
        None,
        record=folder,
        tell=tell,
    )
    say(f"\nopen {folder / 'stepping.html'} in a browser for the picture; next: docs/tutorial.md")
