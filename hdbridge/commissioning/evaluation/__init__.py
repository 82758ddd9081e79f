"""Evaluation of tests: results of a stepping test, comparison of schemes, accuracy by ISO 230-2."""
