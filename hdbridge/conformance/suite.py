"""List of all checks in order, and their execution."""

from collections.abc import Callable, Sequence
from contextlib import suppress

from hdbridge.conformance import description, drive, emergency, lss, motion, network, pdo, sdo
from hdbridge.conformance.tester import (
    Check,
    FailedError,
    NodeTester,
    NotApplicableError,
    Result,
    StoppedError,
    Verdict,
)
from hdbridge.drive.states import State
from hdbridge.errors import DriveError, HdbridgeError

_POWERED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)


def checks(*, moves: bool = False, stores: bool = False) -> list[Check]:
    """Returns the checks in the order of the run.

    Checks that switch power on or write to non-volatile memory are included only on request.
    """
    subjects = (network, lss, sdo, pdo, emergency, description, drive, motion)
    every = [check for subject in subjects for check in subject.CHECKS]
    return [check for check in every if (moves or not check.moves) and (stores or not check.stores)]


def run(
    tester: NodeTester, wanted: Sequence[Check], progress: Callable[[Result], None] = lambda _: None
) -> list[Result]:
    """Runs the checks in order; ``progress`` receives each result.

    Returns the results so far if the user ends the run. Raises `DriveError` if the node does not answer, or
    if its power is on, in which case nothing is changed.
    """
    _refuse_a_powered_drive(tester)
    results = []
    try:
        for check in wanted:
            results.append(run_one(tester, check))
            progress(results[-1])
    except StoppedError:
        pass
    finally:
        if len(results) < len(wanted):
            with suppress(HdbridgeError):
                tester.abandon()
    return results


def run_one(tester: NodeTester, check: Check) -> Result:
    """Runs one check and undoes its changes."""
    verdict, found, expected = Verdict.PASS, "", ""
    begun_s = tester.now
    tester.prepare(moves=check.moves)
    try:
        check.function(tester)
    except FailedError as failure:
        verdict, found, expected = Verdict.FAIL, failure.found, failure.expected
    except NotApplicableError as reason:
        verdict, found = Verdict.NOT_APPLICABLE, str(reason)
    duration_s = tester.now - begun_s
    tester.tidy()
    return Result(check, verdict, found, expected, duration_s)


def _refuse_a_powered_drive(tester: NodeTester) -> None:
    if not tester.answers(tester.timing.boot_s):
        raise DriveError(
            f"node {tester.node_id} on {tester.link.name}: no answer to SDO requests in "
            f"{tester.timing.boot_s:g} s; check node id, bit rate and power, and that the node is not "
            "STOPPED; nothing was changed"
        )
    state = tester.power_state() if tester.has(0x6041) else State.UNKNOWN
    if tester.has(0x6064):
        tester.start_position = tester.read(0x6064, signed=True)
    if state in _POWERED:
        raise DriveError(
            f"node {tester.node_id} on {tester.link.name}: found in {state.value}; expected a drive "
            "without power; disable it with its own master first; nothing was changed"
        )
