"""Benchmarks of time and memory.

Imports every room but the command line's.
"""
