"""The truth behind a demonstration: expectations over hidden steps, exact or sampled.

Imports :mod:`i2rl.models`.
"""
