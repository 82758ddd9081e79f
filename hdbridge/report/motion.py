"""Report page of the motion test: ripple over speed, and the measured response."""

from __future__ import annotations

import math

from hdbridge import __version__
from hdbridge.calibration.motion import MotionTest
from hdbridge.model.response import Response
from hdbridge.report.page import Chart, Grid, Mark, Page, Section, Series, Table


def motion_page(axis_name: str, result: MotionTest) -> Page:
    """Returns the page of one test."""
    return Page(
        title=f"Motion test of axis '{axis_name}'",
        verdict=_verdict(result),
        sections=motion_sections(result),
        footer=f"hdbridge {__version__}. Ripple is the rms error of the load about a straight line.",
    )


def motion_sections(result: MotionTest) -> list[Section]:
    """Returns the ripple over speed, and the response if there is one."""
    sections = [Section("Ripple over speed", blocks=[Grid([_ripple(result)]), _table(result)])]
    if result.response is not None:
        sections.append(
            Section(
                "Response of the load to a correction",
                "At rest the load answers a correction fully: gain 1, phase 0. The filter of the correction "
                "makes up for the rest up to the last known frequency.",
                [Grid(_response(result.response))],
            )
        )
    return sections


def _verdict(result: MotionTest) -> str:
    fastest = result.ripples[-1]
    text = (
        f"At {fastest.speed_deg_s:g} deg/s the compensation removes "
        f"{fastest.removed_in_force_percent or 0.0:.0f} % of the ripple of "
        f"{fastest.none_arcsec:.1f} arcsec."
    )
    return " ".join([text, *(f"{line[0].upper()}{line[1:]}." for line in result.remarks)])


def _ripple(result: MotionTest) -> Chart:
    speeds = [each.speed_deg_s for each in result.ripples]
    none = [each.none_arcsec for each in result.ripples]
    series = [Series("without correction", speeds, none)]
    for name, values in (
        ("correction of rest", [each.static_arcsec for each in result.ripples]),
        ("filtered correction", [each.filtered_arcsec for each in result.ripples]),
    ):
        if any(each is not None for each in values):
            series.append(Series(name, speeds, [math.nan if each is None else each for each in values]))
    return Chart("Ripple of the load", "speed, deg/s", "rms, arcsec", series)


def _table(result: MotionTest) -> Table:
    rows = [
        [
            f"{each.speed_deg_s:g}",
            f"{each.none_arcsec:.2f}",
            "" if each.static_arcsec is None else f"{each.static_arcsec:.2f}",
            "" if each.filtered_arcsec is None else f"{each.filtered_arcsec:.2f}",
            "" if each.removed_percent is None else f"{each.removed_percent:.0f} %",
            " ".join(map(str, each.faded)),
        ]
        for each in result.ripples
    ]
    return Table(["deg/s", "none", "static", "filtered", "removed", "orders faded out"], rows)


def _response(response: Response) -> list[Chart]:
    hertz, gains, phases = response.frequency_hz, response.gain, response.phase_deg
    spread = [gain * share for gain, share in zip(gains, response.uncertainty, strict=True)]
    return [
        Chart("Gain", "frequency, Hz", "gain", [Series("gain", hertz, gains, Mark.POINTS, spread=spread)]),
        Chart("Phase", "frequency, Hz", "phase, deg", [Series("phase", hertz, phases, Mark.POINTS)]),
    ]
