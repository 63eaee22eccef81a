"""Object World: a walled grid with two objects.

Imports :mod:`i2rl.domains.gym`.
"""
