"""Shared by the domains: the Gymnasium environment of a tabular process, and canvases to draw it on.

Imports :mod:`i2rl.models`.
"""
