"""The dissertation's theorems: sample sizes, assumptions, and how often the bounds hold.

Imports the rooms of judging and drawing.
"""
