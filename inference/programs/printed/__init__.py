"""Programs as the dissertation prints them, kept to show why they fail.

Imports :mod:`i2rl.inference.programs`.
"""
