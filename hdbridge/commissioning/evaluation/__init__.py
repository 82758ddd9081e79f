"""Evaluation of tests: figures of a stepping test, comparison of schemes, accuracy by ISO 230-2."""
