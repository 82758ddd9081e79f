"""Conformance of any node on a bus to CiA 301 and CiA 402: timed checks, in one table per subject.

Pure over a `Link` and its clock: the checks run on the virtual bus in simulated time and on a real bus.
"""

from hdbridge.conformance.suite import checks, run
from hdbridge.conformance.tester import Check, NodeTester, Result, Verdict

__all__ = ["Check", "NodeTester", "Result", "Verdict", "checks", "run"]
