"""Benchmarks of statistical behaviour: calibration, coverage, accuracy.

Imports every room but the command line's.
"""
