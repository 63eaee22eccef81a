"""A mouse in a binary-tree labyrinth.

Imports :mod:`i2rl.domains.gym`.
"""
