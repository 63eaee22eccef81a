"""Predict a mouse in a labyrinth, bout by bout.

Imports the rooms of judging, drawing, bounds and posteriors.
"""
