"""Programs as the dissertation prints them, to show why they fail.

Imports :mod:`i2rl.inference.programs`.
"""
