"""Hostile inputs: `python -m tests.hostile`, or `make hostile`."""
