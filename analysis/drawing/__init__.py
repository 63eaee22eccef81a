"""Figures and pages: themes, charts, maps, and the page that a study writes.

Imports :mod:`i2rl.analysis.judging`.
"""
