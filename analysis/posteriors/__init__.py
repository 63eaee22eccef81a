"""Diagnostics of posteriors: convergence, prediction, model comparison, identifiability.

Imports the rooms of judging and drawing.
"""
