"""A corridor of five cells: the smallest process with a hidden stretch, for examples.

Imports :mod:`i2rl.models`.
"""
