"""The learner protocol: states, statistics, schedules, stopping criteria, running and fleets.

Imports :mod:`i2rl.inference.completion`.
"""
