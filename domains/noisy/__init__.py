"""Patrol and sorting seen through noisy perception.

Imports :mod:`i2rl.domains.patrol` and :mod:`i2rl.domains.sorting`.
"""
