"""Onion sorting on a conveyor, in several ways at once.

Imports :mod:`i2rl.domains.gym`.
"""
