"""Onion sorting on a conveyor, with several behaviours.

Imports :mod:`i2rl.domains.gym`.
"""
