"""``hdbridge report``: the report of a calibration, again from its recording."""

from pathlib import Path
from typing import Annotated

import typer

from hdbridge.cli.options import HtmlOption, JsonOption, write_json


def command(
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="Folder of a calibration's recording.")
    ],
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
) -> None:
    """Fit a recording again and report the result; nothing moves."""
    from hdbridge.cli.calibration_output import print_calibration, print_page, write_calibration_page
    from hdbridge.commissioning.calibration import concluded

    result = concluded(recording)
    page = html_file or recording / "report.html"
    write_json(json_file, result.as_dict())
    write_calibration_page(page, result)
    print_calibration(result)
    print_page(page)
