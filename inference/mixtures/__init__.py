"""Mixtures of components: assignments, proportions, and the number of components.

Imports the rooms of programs and completion.
"""
