"""Fleet as the prior for the diagnosis of a single joint: `fleet.parquet` next to the page of a run.

For each cause, it contains the prevalence in each group of joints, the rates of findings in joints with and
without the cause, and the distribution of its parameters over the joints, all estimated from the fleet.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import expit, logit

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.analysis.probability import Prior
from hdbridge.axis.effects import CATALOGUE
from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.fleet.dataset import write_table
from hdbridge.fleet.statistics import OUTLIERS_FROM, normal_range, prevalence
from hdbridge.fleet.summary import Row, grouped, named_by, occurrence, own_recordings

SCHEMA: Final = "hdbridge.fleet-prior/1"
GROUPS: Final = ("gear", "batch", "cell", "lubricant")


def prior_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Estimates the prior from the recordings of a data set (`Dataset.recordings`).

    One row per cause and group; the group of all joints has no attribute.
    """
    joints = own_recordings(rows)[0]
    result: list[dict[str, Any]] = []
    for cause in CATALOGUE:
        found, sick = occurrence(joints, cause)
        common = {"cause": cause, "named": found.named, "wrongly": found.wrongly}
        every = {"joints": len(joints), "cases": len(sick), "share": found.share}
        ranges = _ranges(cause, {name: joints[name] for name in sick})
        result.append({**common, **every, "attribute": None, "group": None, "parameters": ranges})
        for attribute in GROUPS:
            groups = grouped(joints, attribute)
            cases = {group: (len(sick.intersection(own)), len(own)) for group, own in groups.items()}
            pooled = prevalence({"all": (len(sick), len(joints))})["all"].value if cases else 0.0
            for group, share in prevalence(cases).items():
                # The overall prevalence comes from all recordings; the group shifts its odds.
                shifted = float(expit(logit(found.share) + logit(share.value) - logit(pooled)))
                counts = {"cases": cases[group][0], "joints": cases[group][1], "share": shifted}
                result.append({**common, **counts, "attribute": attribute, "group": group, "parameters": []})
    return result


def _ranges(cause: str, joints: Mapping[str, Sequence[Row]]) -> list[dict[str, Any]]:
    """Returns the median and the standard deviation over the joints of each parameter of a cause."""
    values: dict[str, list[float]] = defaultdict(list)
    for own in joints.values():
        last = next(found for row in reversed(own) if (found := named_by(row, cause)))
        for each in last["parameters"] or ():
            if not each["name"].endswith("phase_deg"):  # angles have no median
                values[each["name"]].append(each["value"])
    result = []
    for name, each in values.items():
        normal = normal_range(np.array(each))
        deviation = (normal.high - normal.value) / NORMAL_95
        if len(each) >= OUTLIERS_FROM and deviation > 0.0:
            result.append({"name": name, "middle": normal.value, "deviation": deviation})
    return result


def write_prior(path: Path, rows: Sequence[Row]) -> None:
    """Writes the prior of a data set as one Parquet file."""
    import pyarrow as pa

    text, number = pa.string(), pa.float64()
    ranges = pa.list_(pa.struct([("name", text), ("middle", number), ("deviation", number)]))
    fields = {"cause": text, "attribute": text, "group": text, "joints": pa.int64(), "cases": pa.int64()}
    fields |= {"share": number, "named": number, "wrongly": number, "parameters": ranges}
    write_table(path, prior_rows(rows), pa.schema([*fields.items()], {"schema": SCHEMA}))


def read_prior(path: Path, of: Mapping[str, str]) -> Prior:
    """Reads the prior of a joint in the groups ``of``, by attribute. InputError for a bad file or group."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as problem:
        raise InputError(f"{path}: cannot be read: {str(problem).splitlines()[0]}") from None
    if (table.schema.metadata or {}).get(b"schema") != SCHEMA.encode():
        raise InputError(
            f"{path}: is not the prior of a fleet; expected fleet.parquet in the --out of hdbridge fleet run"
        )
    rows = table.to_pylist()
    for attribute, group in of.items():
        known = sorted({row["group"] for row in rows if row["attribute"] == attribute})
        if group not in known:
            close = nearest(group, known)
            hint = f" (did you mean {close}?)" if close else ""
            raise InputError(f"{path}: no {attribute} '{group}'{hint}; expected {', '.join(known) or 'none'}")
    return joint_prior(rows, of)


def joint_prior(rows: Sequence[Mapping[str, Any]], of: Mapping[str, str]) -> Prior:
    """Returns the prior of a joint in the groups ``of``, by attribute, from the rows of `prior_rows`."""
    right: dict[str, float] = {}
    words: dict[str, str] = {}
    ranges: dict[tuple[str, str], tuple[float, float]] = {}
    for whole in (row for row in rows if row["attribute"] is None):
        cause = whole["cause"]
        groups = [
            row for row in rows if row["cause"] == cause and (row["attribute"], row["group"]) in of.items()
        ]
        odds = logit(whole["share"]) + sum(logit(row["share"]) - logit(whole["share"]) for row in groups)
        right[cause] = float(expit(odds + math.log(whole["named"] / whole["wrongly"])))
        where = " and ".join(f"{row['attribute']} {row['group']}" for row in groups) or "the fleet"
        words[cause] = (
            f"{_percent(float(expit(odds)))} of joints of {where} have it, and {_percent(right[cause])} of "
            "its names there are right"
        )
        for each in whole["parameters"]:
            ranges[cause, each["name"]] = each["middle"], each["deviation"]
    return Prior(right, words, ranges)


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share >= 0.01 else f"{100.0 * share:.2f} %"
