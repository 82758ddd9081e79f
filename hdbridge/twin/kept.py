"""The twin of an axis as a file: a truth file with provenance, stored like a model.

profiles/NAME/twin.yaml           the active twin, which `hdbridge simulate` and `--simulate` use
              pending-twin.yaml   proposed by `hdbridge twin`, not yet committed
              twin-history/       each version that was ever active, and the log
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from hdbridge.axis import AxisConfig, Identity
from hdbridge.errors import InputError
from hdbridge.files.profile import TWIN_NAME
from hdbridge.files.yamlfile import Hex, Line, dump_yaml, write_atomically
from hdbridge.model.binding import binding, check_binding
from hdbridge.model.difference import Difference, flat
from hdbridge.model.file import Provenance
from hdbridge.model.store import Store
from hdbridge.records.record import WRONG_RATIO
from hdbridge.sim.truth import Truth

# ----------------------------------------------------------------
# Difference of two twins by parameter. Pure.

SECTIONS = ("motor", "servo", "gear", "load", "temperature")


def diff(before: Truth | None, after: Truth) -> list[Difference]:
    """Returns all non-default parameters of both twins, changed or not, in the order of the file."""
    old, new = dict(_parameters(before)) if before else {}, dict(_parameters(after))
    widths = {
        place: 0.5 * (upper - lower)
        for twin in (before, after)
        if twin is not None
        for place, (lower, upper) in twin.intervals.items()
    }
    keys = list(dict.fromkeys([*old, *new]))
    keys.sort(key=lambda key: SECTIONS.index(key[0]) if key[0] else -1)
    return [
        Difference(*key, old.get(key), new.get(key), widths.get(".".join(part for part in key if part)))
        for key in keys
    ]


def _parameters(truth: Truth) -> Iterator[tuple[tuple[str, str], Any]]:
    data = truth.model_dump(by_alias=True, mode="json", exclude_defaults=True)
    for section in SECTIONS:
        for name, value in flat(data.get(section, {})):
            yield (section, name), value


# ----------------------------------------------------------------

HEADER: Final = (
    "# The twin of an axis, by hdbridge: what the simulated drive is, learned from recordings.\n"
    "# docs/ci.md describes its keys, docs/twin.md how it came about.\n"
)


@dataclass(frozen=True)
class KeptTwin:
    """A twin and the file that it was read from."""

    truth: Truth
    path: Path | None = field(default=None, compare=False)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a twin's file; InputError with file:line:column."""
        return cls(Truth.load(path), Path(path))

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Axis, drive and gear to which it is bound, date, reason and recordings."""
        return self.truth.provenance

    def with_provenance(self, **provenance: Any) -> Self:
        """Returns the twin with these entries added to its provenance."""
        known = {**self.truth.provenance, **provenance}
        return type(self)(self.truth.model_copy(update={"provenance": known}), self.path)

    def bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> Self:
        """Returns the twin bound to an axis and the drive that answered (else the axis file's)."""
        return self.with_provenance(**binding(axis, identity))

    def check_ratio(self, axis: AxisConfig) -> None:
        """Raises InputError if the twin has another gear ratio than the axis file.

        The ratio compared is the one of the measurement; the gear's true ratio may differ by a `ratio_error`.
        """
        bound = Provenance.model_validate(self.truth.provenance).gear
        ratio, allowed = (bound.ratio, 1e-9) if bound else (self.truth.gear.ratio, WRONG_RATIO)
        if not math.isclose(ratio, axis.gear.ratio, rel_tol=allowed):
            raise InputError(
                f"{self._name()}: gear.ratio: this twin is of a gear with ratio {ratio:g}, but {axis.path} "
                f"says {axis.gear.ratio:g}; use the twin of this gear, or make one"
            )

    def check_bound_to(self, axis: AxisConfig, identity: Identity | None = None) -> None:
        """Raises InputError if the twin belongs to another drive, axis or gear."""
        self.check_ratio(axis)
        check_binding(self.truth.provenance, axis, identity, self._name(), "twin", "make one")

    def dump(self) -> str:
        """Returns the file's text, which reads back exactly; default values are omitted."""
        data = self.truth.model_dump(by_alias=True, mode="json", exclude_defaults=True)
        provenance = data.get("provenance", {})
        drive, about = provenance.get("drive"), provenance.get("fit")
        if isinstance(drive, dict):
            provenance["drive"] = {
                name: Hex(value) if isinstance(value, int) else value for name, value in drive.items()
            }
        if isinstance(about, dict) and "covariance" in about:
            provenance["fit"] = {**about, "covariance": [Line(row) for row in about["covariance"]]}
        if "intervals" in data:
            data["intervals"] = {place: Line(pair) for place, pair in data["intervals"].items()}
        return HEADER + dump_yaml(data)

    def save(self, path: Path | str) -> None:
        """Writes the file atomically."""
        write_atomically(path, self.dump())

    def _name(self) -> str:
        return str(self.path) if self.path else "this twin"


TWINS: Final = Store(
    "twin",
    TWIN_NAME,
    "pending-twin.yaml",
    "twin-history",
    "make one with 'hdbridge twin'",
    "hdbridge model log PROFILE --twin",
    KeptTwin.load,
)
"""The twins of a profile."""
