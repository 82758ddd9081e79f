"""Conformance tests of a node (CiA 301, 305, 306 and 402): timed checks, in one table per subject.

The checks use only a `Link` and its clock, so they run on a virtual bus in simulated time and on a real bus.
"""

from hdbridge.conformance.suite import checks, run
from hdbridge.conformance.tester import Check, NodeTester, Result, Verdict

__all__ = ["Check", "NodeTester", "Result", "Verdict", "checks", "run"]
