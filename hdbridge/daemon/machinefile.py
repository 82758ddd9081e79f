"""Schema of the machine file: axes, bus, access, recorder, adaptation.

A user writes ``machine.yaml``; the program never changes it. `hdbridge.daemon.machine` reads it together with
its profiles.
"""

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from hdbridge.axis import BusConfig, RealtimeConfig
from hdbridge.daemon.memory.layout import AXES_AT_MOST
from hdbridge.enums import AdaptationMode, Scheme
from hdbridge.errors import InputError
from hdbridge.strictness import Strict

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
"""Pattern of a machine's name, which is also the name of its socket and service."""
_TOKEN = re.compile(r"[A-Za-z0-9._~-]{16,200}")
Parameter = Annotated[str, Field(pattern=r"^[a-z_]+\.[a-z_]+$")]


class RecorderSettings(Strict):
    """Settings of the ring on disk and of the recordings kept."""

    folder: str | None = Field(
        None,
        min_length=1,
        description="folder of the recordings; by default recordings/daemon next to this file, or in the "
        "state folder of the service",
    )
    size_mb: float = Field(2000.0, ge=1, le=1e7, description="size of the ring")
    age_days: float = Field(30.0, gt=0, le=36_500, description="age at which a file of the ring is removed")
    file_mb: float = Field(64.0, ge=0.1, le=4000, description="size at which the next file begins")
    file_s: float = Field(300.0, ge=5, le=86_400, description="time after which the next file begins")
    before_s: float = Field(60.0, ge=0, le=86_400, description="time before each fault that is kept")
    after_s: float = Field(30.0, ge=0, le=86_400, description="time after each fault that is kept")
    kept_mb: float = Field(1000.0, ge=1, le=1e7, description="size of the recordings kept for faults")
    free_mb: float = Field(100.0, ge=0, le=1e7, description="free disk space below which nothing is recorded")


class Excitation(Strict):
    """Motion required between two updates of the estimate."""

    turns: float = Field(
        2.0, ge=0.5, le=1000, description="motor turns, both directions together, for the motor orders"
    )
    reversals: int = Field(2, ge=1, le=1000, description="reversals, to separate the loop from the zero")
    samples: int = Field(10, ge=2, le=10_000, description="standstills and stretches of slow motion")


class AdaptationSettings(Strict):
    """Settings of the adaptation. Rates are per hour of axis time, bounds relative to the committed model."""

    mode: AdaptationMode = Field(AdaptationMode.OFF, description="observe only reports what would change")
    parameters: tuple[Parameter, ...] | None = Field(
        None,
        description="adapted parameters, as EFFECT.PARAMETER; by default all changed by wear or temperature",
    )
    rate_arcsec_per_hour: float = Field(
        30.0, gt=0, le=36_000, description="fastest change of any coefficient of the model"
    )
    zero_rate_arcsec_per_hour: float = Field(
        60.0, gt=0, le=36_000, description="fastest plausible change of the zero (reported, never applied)"
    )
    bound_share: float = Field(
        0.5, gt=0, le=1, description="largest deviation of a coefficient, as a fraction of the committed one"
    )
    least_bound_arcsec: float = Field(
        5.0, ge=0, le=3600, description="largest deviation, if bound_share permits less"
    )
    zero_bound_arcsec: float = Field(60.0, gt=0, le=3600, description="largest plausible change of the zero")
    half_life_turns: float = Field(
        40.0, ge=1, le=1e6, description="motor turns after which older observations count half"
    )
    excitation: Excitation = Field(default_factory=Excitation, description="motion required for an update")
    slow_deg_s: float = Field(0.5, gt=0, le=100, description="highest load speed at which motion is used")
    interval_s: float = Field(
        60.0, ge=1, le=86_400, description="minimum time between changes of the model in use"
    )
    smallest_arcsec: float = Field(
        0.1, ge=0, le=100, description="smallest change of a coefficient that is applied"
    )
    folder: str | None = Field(
        None,
        min_length=1,
        description="folder of AXIS.json and AXIS.log.jsonl; by default 'adaptation' next to the axis file",
    )


class LoadLoopSettings(Strict):
    """Load loop: a slow integral of the error at the load encoder, in addition to the model."""

    gain_1_s: float = Field(0.5, gt=0, le=5, description="fraction of the error removed per second")
    maximum_arcsec: float = Field(30.0, gt=0, le=3600, description="largest correction, at the load")
    slew_arcsec_s: float = Field(
        20.0, gt=0, le=10_000, description="fastest change of the correction, at the load"
    )


class AxisEntry(Strict):
    """One axis of the machine."""

    profile: str = Field(
        min_length=1,
        description="folder with axis.yaml or axis file, relative to this file, or a bundled profile",
    )
    compensation: Scheme = Field(
        Scheme.EXTENDED, description="part of the active model that compensates; extended is the whole model"
    )
    adapt: AdaptationMode | None = Field(
        None, description="adaptation mode of this axis; by default adaptation.mode"
    )
    load_loop: LoadLoopSettings | None = Field(
        None, description="slow control loop on the load encoder; by default none"
    )


class TcpSettings(Strict):
    """API over TCP on this machine, for the page, local tools and a reverse proxy."""

    port: int = Field(8402, ge=1, le=65_535, description="port of 127.0.0.1")
    names: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]+$")], ...] = Field(
        (), description="host names of a reverse proxy on this machine"
    )
    token_file: str = Field(min_length=1, description="file with the clients' token, mode 600")


class ApiSettings(Strict):
    """Access of clients to the daemon."""

    socket: str | None = Field(
        None, min_length=1, description="Unix socket; by default NAME.sock in the runtime folder"
    )
    group: str | None = Field(
        None, min_length=1, description="group whose members may use the socket; by default the daemon's"
    )
    tcp: TcpSettings | None = Field(None, description="additional TCP port; by default none")


class GatewaySettings(Strict):
    """The machine as CiA-402 drives on another bus, for its master. Positions are those of the load."""

    bus: BusConfig = Field(description="the bus of the other master")
    nodes: dict[str, Annotated[int, Field(ge=1, le=127)]] = Field(
        min_length=1, description="node id of each axis on the other master's bus, by axis name"
    )
    counts_per_turn: int = Field(
        12_960_000, ge=3600, le=1 << 28, description="increments per load turn (default 0.1 arcsec each)"
    )
    timeout_ms: float = Field(
        100.0,
        ge=10,
        le=10_000,
        description="time without set-points after which an axis at rest loses power; in motion it keeps its "
        "speed for a fifth of this time, then brakes",
    )


class LimitSettings(Strict):
    """Limits of the daemon."""

    restarts_per_minute: int = Field(
        3, ge=0, le=60, description="restarts of a dead control process before the daemon ends"
    )


class MachineFile(Strict):
    """Content of a machine file."""

    schema_: Literal["hdbridge.machine/1"] = Field(
        alias="schema", description="schema and version of this file"
    )
    name: str = Field(pattern=NAME, description="name: letters, digits, '.', '_', '-'")
    axes: tuple[AxisEntry, ...] = Field(
        min_length=1, max_length=AXES_AT_MOST, description="the axes, all on one bus with one cycle"
    )
    bus: BusConfig | None = Field(
        None, description="the CAN bus; by default that of the axis files, which must agree"
    )
    api: ApiSettings = Field(default_factory=ApiSettings, description="access of clients to the daemon")
    lease_s: Annotated[float, Field(ge=0.5, le=3600)] = Field(
        10.0, description="time after which an unrenewed lease expires"
    )
    limits: LimitSettings = Field(default_factory=LimitSettings, description="limits of the daemon")
    recorder: RecorderSettings = Field(default_factory=RecorderSettings, description="flight recorder")
    gateway: GatewaySettings | None = Field(
        None, description="axes as drives of another master; by default none"
    )
    adaptation: AdaptationSettings = Field(
        default_factory=AdaptationSettings, description="adaptation of model parameters to the load encoder"
    )
    realtime: RealtimeConfig | None = Field(
        None, description="scheduling; by default that of the axis files, which must agree"
    )


def read_token(path: Path) -> str:
    """Reads the token from ``path``; raises InputError if it is invalid, or if others can read the file."""
    try:
        content, mode = path.read_text(encoding="ascii").strip(), path.stat().st_mode
    except (OSError, UnicodeDecodeError) as problem:
        reason = problem.strerror if isinstance(problem, OSError) else "not ASCII text"
        raise InputError(
            f"{path}: cannot be read: {reason}; expected a file with the token in one line"
        ) from None
    if mode & 0o077:
        raise InputError(
            f"{path} can be read by others (mode {mode & 0o777:o}); expected mode 600: chmod 600 {path}"
        )
    if not _TOKEN.fullmatch(content):
        raise InputError(
            f"{path}: expected a token of 16 to 200 letters, digits, '-', '.', '_' or '~'; make one: "
            f"openssl rand -hex 16 > {path}"
        )
    return content
