"""Notebooks to be read in order, and what executes them: :mod:`i2rl.analysis.notebooks.execute`."""
