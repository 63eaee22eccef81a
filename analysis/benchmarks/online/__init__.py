"""Benchmarks of online learning against batch: accuracy, regret, stopping, and what is kept.

Imports every room but the command line's.
"""
