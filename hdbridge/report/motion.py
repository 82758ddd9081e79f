"""Report page of the motion test: ripple over speed, and the measured response."""

import math
from collections.abc import Iterator, Sequence

from hdbridge import __version__
from hdbridge.axis.model.response import Response
from hdbridge.commissioning.calibration.motion import MotionTest, OrderRipple, Ripple
from hdbridge.report.page import Chart, Facts, Grid, Heading, Mark, Page, Section, Series, Table

RIPPLE_COLUMNS = ("deg/s", "none", "static", "removed", "filtered", "removed", "orders faded out")
PATH_COLUMNS = ("path", "correction", "path error", "with wind-up", "at rest", "settled after, ms")
PATH_WORDS = (
    "Errors of the load over a move at the limits and over a sine, rms arcsec. The path error is without the "
    "servo's lag and the wind-up of the load; 'with wind-up' includes them, on the same curve with the "
    "static and the filtered correction. If that figure grows while the path error falls, the removed "
    "error had hidden part of the curve. At rest: mean error after the path. "
    "Settled: the load stays within 3 arcsec of its rest."
)


def motion_page(axis_name: str, result: MotionTest) -> Page:
    """Returns the page of a motion test."""
    return Page(
        title=f"Motion test of axis '{axis_name}'",
        verdict=_verdict(result),
        sections=motion_sections(result),
        footer=f"hdbridge {__version__}. Ripple is the rms error of the load about a straight line.",
    )


def motion_sections(result: MotionTest) -> list[Section]:
    """Returns the sections: ripple over speed, motor orders, path errors and response, if measured."""
    sections = [
        Section(
            "Ripple over speed, rms arcsec",
            blocks=[Grid([_ripple(result)]), Table(RIPPLE_COLUMNS, _ripple_rows(result))],
        ),
        Section(
            "Motor orders",
            "Amplitude of each motor order of the load error.",
            [_orders(result.ripples[-1]), Grid([_spectrum(each) for each in result.ripples if each.orders])],
        ),
    ]
    if result.paths:
        sections.append(
            Section("Errors on a path, rms arcsec", PATH_WORDS, [Table(PATH_COLUMNS, _path_rows(result))])
        )
    if result.response is not None:
        sections.append(
            Section(
                "Response of the load to a correction",
                "At rest the load answers a correction fully: gain 1, phase 0. In motion the response "
                "differs, and the filter compensates for it up to the last known frequency.",
                [Grid(_response(result.response))],
            )
        )
    sections.append(Section("Result", blocks=[Facts([*_facts(result)])]))
    return sections


def _facts(result: MotionTest) -> Iterator[tuple[str, str]]:
    if (response := result.response) is not None:
        lag = f"following lag {response.following_lag_ms:.2f} ms"
        yield "response", f"known up to {response.known_to_hz:.0f} Hz, {lag}"
    if result.wind_up is not None:
        value = f"{result.wind_up.inertia_over_stiffness_s2:.3g} s2"
        yield "wind-up J / K", f"{value}, compensated in acceleration"
    if (reached := result.helps_to_deg_s) is not None:
        yield "the compensation removes half of the ripple or more", f"up to {reached:g} deg/s"
    yield from (("note", each) for each in result.remarks)


def _orders(ripple: Ripple) -> Table:
    rows = [
        [
            str(each.order),
            f"{each.frequency_hz:.0f}",
            *map(_figure, (each.none_arcsec, each.static_arcsec, each.filtered_arcsec)),
        ]
        for each in ripple.orders
    ]
    columns = [Heading(each) for each in ("none", "static", "filtered")]
    return Table([f"order, at {ripple.speed_deg_s:g} deg/s", Heading("frequency", "Hz"), *columns], rows)


def _verdict(result: MotionTest) -> str:
    fastest = result.ripples[-1]
    text = (
        f"At {fastest.speed_deg_s:g} deg/s the compensation removes "
        f"{fastest.removed_in_force_percent or 0.0:.0f} % of the ripple of "
        f"{fastest.none_arcsec:.1f} arcsec."
    )
    return " ".join([text, *(f"{line[0].upper()}{line[1:]}." for line in result.remarks)])


def _ripple(result: MotionTest) -> Chart:
    series = _curves([each.speed_deg_s for each in result.ripples], result.ripples, Mark.LINE)
    return Chart("Ripple of the load", "speed, deg/s", "rms, arcsec", series)


def _spectrum(ripple: Ripple) -> Chart:
    series = _curves([each.frequency_hz for each in ripple.orders], ripple.orders, Mark.POINTS)
    return Chart(f"{ripple.speed_deg_s:g} deg/s", "frequency, Hz", "amplitude, arcsec", series)


def _curves(x: list[float], errors: Sequence[Ripple] | Sequence[OrderRipple], mark: Mark) -> list[Series]:
    """Returns the errors without and with each correction that was measured."""
    series = [Series("without correction", x, [each.none_arcsec for each in errors], mark)]
    for name, values in (
        ("static correction", [each.static_arcsec for each in errors]),
        ("filtered correction", [each.filtered_arcsec for each in errors]),
    ):
        if any(each is not None for each in values):
            series.append(Series(name, x, [math.nan if each is None else each for each in values], mark))
    return series


def _ripple_rows(result: MotionTest) -> list[list[str]]:
    return [
        [
            f"{each.speed_deg_s:g}",
            _figure(each.none_arcsec),
            _figure(each.static_arcsec),
            _percent(each.removed_static_percent),
            _figure(each.filtered_arcsec),
            _percent(each.removed_percent),
            " ".join(map(str, each.faded_orders)),
        ]
        for each in result.ripples
    ]


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.0f} %"


def _path_rows(result: MotionTest) -> list[list[str]]:
    return [
        [
            each.name,
            name,
            f"{one.path_arcsec:.2f}",
            f"{one.delayed_arcsec:.2f}",
            f"{one.rest_arcsec:.2f}",
            f"{1000.0 * one.settle_s:.0f}",
        ]
        for each in result.paths
        for name, one in (
            ("none", each.none),
            ("static", each.static),
            ("filtered", each.filtered),
            ("wind-up compensated", each.wind_up),
        )
        if one is not None
    ]


def _response(response: Response) -> list[Chart]:
    hertz, gains, phases = response.frequency_hz, response.gain, response.phase_deg
    spread = [gain * share for gain, share in zip(gains, response.uncertainty, strict=True)]
    return [
        Chart("Gain", "frequency, Hz", "gain", [Series("gain", hertz, gains, Mark.POINTS, spread=spread)]),
        Chart("Phase", "frequency, Hz", "phase, deg", [Series("phase", hertz, phases, Mark.POINTS)]),
    ]
