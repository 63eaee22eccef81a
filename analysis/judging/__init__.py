"""Metrics of learned rewards and policies, with their intervals.

Imports :mod:`i2rl.inference` and :mod:`i2rl.domains`.
"""
