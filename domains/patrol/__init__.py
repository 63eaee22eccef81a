"""Perimeter patrol: robots walk hallways in loops, watched through a keyhole, and a learner slips past.

Imports :mod:`i2rl.domains.gym`.
"""
