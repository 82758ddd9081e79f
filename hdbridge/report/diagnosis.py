"""Report page of a diagnosis: verdict, advice, each finding with its chart, and all observations."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from hdbridge import __version__
from hdbridge.analysis.capability import certainty
from hdbridge.analysis.findings import UNEXPLAINED, Diagnosis, Finding
from hdbridge.analysis.views import ResidualViews
from hdbridge.axis.effects import CATALOGUE
from hdbridge.commissioning.calibration.pipeline import Offer
from hdbridge.commissioning.calibration.validation import Validation
from hdbridge.report.page import (
    SIGMA,
    Block,
    Command,
    Facts,
    Grid,
    Heading,
    Page,
    Section,
    Status,
    Table,
    sentence,
    with_interval,
)
from hdbridge.report.residuals import beside_charts, partial_residual, partial_residual_chart, residual_charts
from hdbridge.report.stepping import of_offer, stepping_sections
from hdbridge.units import without_unit

MAX_CLAIMS: Final = 3
"""Maximum number of findings in the verdict."""
PLUS_MINUS: Final = "\N{PLUS-MINUS SIGN} 95 %"


def diagnosis_page(
    diagnosis: Diagnosis,
    *,
    title: str,
    provenance: Mapping[str, str] | Sequence[tuple[str, str]] = (),
    stepping: Validation | None = None,
    offer: Offer | None = None,
    command: str = "hdbridge diagnose RECORD... --model MODEL.yaml",
) -> Page:
    """Returns the page of a diagnosis.

    ``provenance`` contains names and values that describe the origin of records and model. ``stepping`` is
    the stepping test with the old and the extended model, if there was one; it precedes the findings.
    ``offer`` is the outcome for the extended model, if it was tested for commit. ``command`` is the command
    line of the diagnosis.
    """
    seen = diagnosis.views()
    verdict = _verdict(diagnosis, stepping)
    given = provenance.items() if isinstance(provenance, Mapping) else provenance
    sections = [_to_do(diagnosis)]
    if stepping is not None:
        sections += stepping_sections(stepping)
    if diagnosis.findings:
        sections.append(_found(diagnosis))
    sections += [_finding(number, each, diagnosis) for number, each in enumerate(diagnosis.findings, 1)]
    sections += [
        _figures(diagnosis),
        Section(
            "Model and measurement",
            "The transmission error on the same trajectory: load encoder minus motor angle divided by the "
            "ratio, without the zero offset.",
            [Grid([*beside_charts(diagnosis.traces)], columns=1)],
        ),
        _over(seen),
        _could(diagnosis),
    ]
    if facts := [*_remarks(diagnosis), *given]:
        sections.append(Section("Provenance", "", [Facts(facts)]))
    if offer is not None:
        status, commands = of_offer(offer)
    else:
        status = Status.FOUND if diagnosis.findings else Status.NOTHING_FOUND
        commands = _commands(diagnosis, command)
    return Page(
        title=title,
        verdict=f"{sentence(offer.reason)} {verdict}" if offer is not None else verdict,
        status=status,
        commands=commands,
        sections=sections,
        footer=f"hdbridge {__version__}. Errors are arcseconds at the load; rms is the root mean square, "
        f"{SIGMA} three standard deviations; intervals are of 95 %.",
    )


def _commands(diagnosis: Diagnosis, command: str) -> tuple[Command, ...]:
    if all(each.cause == UNEXPLAINED for each in diagnosis.findings):
        return ()
    return (
        Command(f"{command} --extend NEW_MODEL.yaml", "writes the extended model"),
        Command("hdbridge improve PROFILE", "tries it on the axis, and keeps it as pending if it is better"),
    )


def _verdict(diagnosis: Diagnosis, stepping: Validation | None) -> str:
    given, own, after = (
        _two(each.rms_arcsec) for each in (diagnosis.baseline, diagnosis.refitted, diagnosis.extended)
    )
    noise = f"the noise of a reading is {_two(diagnosis.noise_floor_arcsec)}"
    if not diagnosis.findings:
        text = (
            f"Model and measurement are {given} arcsec (rms) apart, which noise and an "
            f"everyday calibration account for; {noise}."
        )
    else:
        causes = _listed([_claim(each) for each in diagnosis.findings[:MAX_CLAIMS]])
        if more := len(diagnosis.findings[MAX_CLAIMS:]):
            causes += f"; and {more} more"
        text = f"The model is off by {given} arcsec (rms): {causes}."
        if all(each.cause == UNEXPLAINED for each in diagnosis.findings):
            text += f" No cause of the catalogue fits it; {noise}."
        else:
            same = "a refit of its own parameters does the same"
            alone = same if own == after else f"with only its own parameters refitted {own}"
            text += f" With that in the model {after} remain; {alone}; {noise}."
    text = f"{diagnosis.capability.sentence()} {text}"
    if stepping is not None:
        before, now = stepping.before.pooled.three_sigma_arcsec, stepping.after.pooled.three_sigma_arcsec
        text += f" On the axis, stepping went from {SIGMA} = {before:.2f} to {now:.2f} arcsec."
    return text


def _claim(finding: Finding) -> str:
    """Describes a finding with its certainty: "backlash behind the gear, up to 3.1 arcsec"."""
    if finding.cause == UNEXPLAINED:
        size = f"up to {_two(finding.peak_arcsec)} arcsec"
        return f"something unexplained that depends on the {finding.lives_in or 'time'}, {size}"
    name = _title(finding.cause)
    if finding.aliases:
        name = _listed([name, *map(_title, finding.aliases)], "or")
    return f"{certainty(finding.probability)}{name}, up to {_two(finding.peak_arcsec)} arcsec"


def _to_do(diagnosis: Diagnosis) -> Section:
    if not diagnosis.findings:
        return Section(
            "What to do",
            "Nothing. 'What this record could show' lists the causes that it would have shown, and those "
            "that it would not.",
        )
    rows: list[tuple[str, str]] = []
    for number, each in enumerate(diagnosis.findings, 1):
        remedy = "do not compensate for an unexplained error; investigate it first, and keep the record"
        if each.cause in CATALOGUE:
            remedy = CATALOGUE[each.cause].about.remedy
        rows.append((f"{number}. {_name(each.cause)}", sentence(remedy)))
        if each.experiment:
            rows.append(("measure next", sentence(each.experiment)))
    return Section("What to do", "", [Facts(rows)])


def _found(diagnosis: Diagnosis) -> Section:
    rows: list[list[str | float]] = []
    for number, each in enumerate(diagnosis.findings, 1):
        rows.append(
            [
                f"{number}. {_name(each.cause)}",
                f"{each.probability:.2f}",
                each.peak_arcsec,
                each.gain.before_arcsec if each.gain else "not made",
                each.gain.after_arcsec if each.gain else "",
                f"{100.0 * each.gain.recovered:.0f} %" if each.gain else "",
                each.refusal() or "yes",
            ]
        )
    header: list[str | Heading] = [
        "cause",
        Heading("probability", ""),
        Heading("size"),
        Heading("held out, without"),
        Heading("with"),
        Heading("gain", "of the squares"),
        "offered",
    ]
    return Section(
        "What was found",
        "Size: half the span of its contribution to this record. Held out: residual (rms) of the given model "
        "with the other findings, and of the written model, on stretches of time left out of the fit. "
        "Gain: the fraction of the mean square removed. "
        "Offered: an improvement of the model may contain it; if not, the reason.",
        [Table(header, rows)],
    )


def _finding(number: int, finding: Finding, diagnosis: Diagnosis) -> Section:
    title = _title(finding.cause)
    drawn = partial_residual(finding, diagnosis)
    blocks: list[Block] = [partial_residual_chart(drawn)]
    if finding.parameters:
        blocks.append(_parameters(finding))
    blocks.append(Facts([*_about(finding)]))
    if drawn.strength is not None:
        text = (
            f"Growth of the {drawn.strength.of} of the model, by least squares in each bin; "
            "bars are one standard deviation."
        )
    elif drawn.own_arcsec is None:
        text = "The residual that no cause explains. Dots are means, bars the spread of the readings in them."
    else:
        text = (
            "All other findings are in the model, so this is the finding alone, with the noise. Dots are "
            "means, bars the spread of their readings, lines the finding's contribution."
        )
    return Section(f"{number}. {sentence(title).rstrip('.')}", text, blocks)


def _parameters(finding: Finding) -> Table:
    rows: list[list[str | float]] = []
    for name, each in finding.parameters.items():
        words = without_unit(name).replace("_", " ")
        unit = "" if each.unit == "1" else each.unit
        if each.high > each.low:
            value, half = with_interval(each.value, 0.5 * (each.high - each.low))
            low, high = (with_interval(one, 0.5 * (each.high - each.low))[0] for one in (each.low, each.high))
            rows.append([words, value, half, low, high, unit])
        else:
            rows.append([words, f"{each.value:.7g}", "by search", "", "", unit])
    return Table(["parameter", "value", PLUS_MINUS, "from", "to", "unit"], rows)


def _about(finding: Finding) -> Iterator[tuple[str, str]]:
    about = CATALOGUE[finding.cause].about if finding.cause in CATALOGUE else None
    yield "probability", _sure(finding)
    yield (
        "aliases",
        _listed([*map(_title, finding.aliases)], "or")
        if finding.aliases
        else "no other cause of the catalogue: all are separable with these data"
        if about
        else "no cause of the catalogue fits",
    )
    if finding.lives_in:
        yield "depends on", finding.lives_in
    if about:
        yield "symptom", sentence(about.signature)
        yield "consequence", sentence(about.consequence)
        able = CATALOGUE[finding.cause].compensable
        yield "compensation", f"{'possible' if able.possible else 'no'}: {able.why.removeprefix('no, ')}"
        yield "equation", about.equation
        yield "name in files", finding.cause
    if finding.note:
        yield "note", sentence(finding.note)
    if finding.prior:
        yield "prior", sentence(finding.prior)


def _sure(finding: Finding) -> str:
    if finding.cause == UNEXPLAINED:
        return f"{finding.probability:.2f} that there is something which the catalogue does not have"
    others = ", or one that it cannot be distinguished from," if finding.aliases else ""
    return f"{finding.probability:.2f} that this cause{others} is there"


def _figures(diagnosis: Diagnosis) -> Section:
    stages: list[list[str | float]] = [
        [words, each.rms_arcsec, each.three_sigma_arcsec]
        for words, each in (
            ("the model as given", diagnosis.baseline),
            ("its own parameters refitted", diagnosis.refitted),
            ("extended", diagnosis.extended),
        )
    ]
    stages.append(["noise of a reading", diagnosis.noise_floor_arcsec, 3.0 * diagnosis.noise_floor_arcsec])
    kinds: list[list[str | float]] = [
        [name, one.rms_arcsec, one.three_sigma_arcsec, other.rms_arcsec, other.three_sigma_arcsec]
        for name, (one, other) in diagnosis.by_kind.items()
    ]
    return Section(
        "Figures",
        "Differences between model and measurement: overall, by kind of motion and by direction.",
        [
            Table(["overall", Heading("rms"), Heading(SIGMA)], stages),
            Table(["motion", *map(Heading, ("as given, rms", SIGMA, "extended, rms", SIGMA))], kinds),
        ],
    )


def _over(seen: ResidualViews) -> Section:
    shares = sorted(seen.shares().items(), key=lambda each: -each[1][0])
    rows: list[list[str | float]] = [
        [name, f"{100.0 * before:.1f} %", f"{100.0 * after:.1f} %"] for name, (before, after) in shares
    ]
    return Section(
        "Residuals over all coordinates",
        "Measurement minus model; lines are means over bins, grey dots readings minus the model as given, "
        "all charts to one scale, the most informative first.\n\nThe table lists the fraction of the mean "
        "square that such means predict on other stretches of time.",
        [
            Grid([*residual_charts(seen)]),
            Table(
                ["over the", Heading("as given", "of the squares"), Heading("extended", "of the squares")],
                rows,
            ),
        ],
    )


def _could(diagnosis: Diagnosis) -> Section:
    rows: list[list[str | float]] = []
    ranked = sorted(
        diagnosis.identifiability.items(),
        key=lambda each: (not each[1].detectable, each[1].detection_limit_arcsec or 0.0),
    )
    for name, each in ranked:
        limit = each.detection_limit_arcsec
        rows.append(
            [
                _title(name),
                f"{limit:.2f}" if limit is not None and each.detectable else "not seen",
                each.reason or ", ".join(map(_name, each.aliases)),
            ]
        )
    return Section(
        "What this record could show",
        "Detection limit and aliases of each cause, or the reason why it is not detectable.",
        [Table(["cause", Heading("from"), "not separable from, or why not"], rows)],
    )


def _remarks(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    yield from (("about the record", each) for each in diagnosis.remarks)
    yield from (("considered, not named", each.replace("_", " ")) for each in diagnosis.considered)
    yield "samples evaluated", f"{len(diagnosis.traces.time_s):,}"


def _name(cause: str) -> str:
    return cause.replace("_", " ")


def _title(cause: str) -> str:
    """Returns the title of a cause, preceded by its name unless the title contains it."""
    name = _name(cause)
    if cause not in CATALOGUE:
        return name
    title = CATALOGUE[cause].about.title
    return title if name in title else f"{name} ({title})"


def _listed(words: Sequence[str], last: str = "and") -> str:
    if len(words) < 2 or any("," in each for each in words):
        return "; ".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def _two(value: float) -> str:
    """Formats a value with two decimals, or with one decimal from 10 on."""
    return f"{value:.1f}" if value >= 9.95 else f"{value:.2f}"
