"""Adversarial learners of tabular tasks, with an exact expert and an exact generator.

Imports the rooms of sensors, sessions and completion, and :mod:`i2rl.models.networks`.
"""
