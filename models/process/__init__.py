"""The decision process: states, actions, features, and planning in it.

Imports :mod:`i2rl.models.inputs`.
"""
