"""Rewards and policies as networks, and the protocol of tasks that they act in.

Needs the extra ``adversarial``. Imports :mod:`i2rl.models.inputs`.
"""
