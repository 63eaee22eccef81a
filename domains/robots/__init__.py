"""Continuous tasks: locomotion, classic control, and onions sorted by a moving wrist.

Needs the extra ``adversarial``. Imports :mod:`i2rl.inference.adversarial` and :mod:`i2rl.models.networks`.
"""
