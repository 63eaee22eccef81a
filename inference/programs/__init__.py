"""Convex programs of the M-step: maximum entropy in JAX, CasADi and CVXPY, proportions, reliabilities.

Imports :mod:`i2rl.models`.
"""
