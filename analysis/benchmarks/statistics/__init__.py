"""Benchmarks of statistical behaviour: calibration, coverage, components found.

Imports every room but the command line's.
"""
