"""``hdbridge fit``: a model from recordings alone, hdbridge's own or any CSV files."""

from pathlib import Path
from typing import Annotated

import typer

from hdbridge.cli.options import (
    ColumnsOption,
    HtmlOption,
    IndependentZerosOption,
    JsonOption,
    UnitsOption,
    UnwrapOption,
    load_recordings,
    model_file,
    say,
    write_json,
    write_result,
)
from hdbridge.errors import InputError
from hdbridge.files.outputs import Kind
from hdbridge.files.profile import Profile


def command(
    records: Annotated[
        list[Path],
        typer.Argument(metavar="RECORD...", help="Recording folders or CSV files, in order of time."),
    ],
    ratio: Annotated[
        float | None,
        typer.Option("--ratio", min=1, max=1000, help="Motor turns per load turn; else the recording's."),
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option("--axis", metavar="PROFILE", help="The axis that was recorded: ratio and binding."),
    ] = None,
    active: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL.yaml|PROFILE",
            help="Model to compare with, and to fall back on.",
        ),
    ] = None,
    columns: ColumnsOption = None,
    units: UnitsOption = None,
    unwrap: UnwrapOption = None,
    independent_zeros: IndependentZerosOption = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="MODEL.yaml", help="Write the model file."), Kind.MODEL
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write the model even if it is worse on held-out data.")
    ] = False,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Fit a model to recordings; report parameter intervals and what the data cannot determine.

    A CSV file needs `time_s`, `motor_position_deg` and `load_position_deg` (multi-turn), or other names by
    --columns; `motor_target_deg` helps. Nothing is activated. A model that is worse on held-out data than
    that of --model, or than none, is not written.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.cli.calibration_output import print_calibration, print_page, write_calibration_page
    from hdbridge.commissioning.calibration import fit

    config = AxisConfig.load(Profile.find(axis).axis) if axis else None
    loaded = load_recordings(records, columns, units, unwrap)
    compared = TransmissionModel.load(model_file(active)) if active else None
    if compared and config:
        compared.check_bound_to(config)
    found = fit(
        loaded,
        ratio=ratio,
        axis=config,
        active=compared,
        independent_zeros=independent_zeros,
    )
    held_out = found.fit.held_out
    refused = out is not None and held_out.worse and not force
    if out is not None and not refused:
        write_result(out, found.model.dump())
    write_json(json_file, found.as_dict())
    if html_file is not None:
        write_calibration_page(html_file, found)
    print_calibration(found)
    if out is not None and not refused:
        say(f"model: {out}")
    if html_file is not None:
        print_page(html_file)
    if refused:
        raise InputError(
            f"{out}: not written: the model is worse on held-out data; it {held_out.text}; record more, or "
            "write it anyway with --force"
        )
