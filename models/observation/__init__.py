"""Demonstrations, and sensors as evidence about hidden state-action pairs.

Imports :mod:`i2rl.models.process` and :mod:`i2rl.models.inputs`.
"""
