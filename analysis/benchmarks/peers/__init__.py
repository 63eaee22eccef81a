"""Benchmarks beside other libraries, each in an interpreter of its own.

Imports every room but the command line's.
"""
