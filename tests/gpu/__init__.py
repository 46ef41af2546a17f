"""Checks on a CUDA GPU: `python -m tests.gpu`, or `make gpu`."""
