"""Laws of trajectories: the hidden Markov chain over pairs, and the declared NumPyro and PyMC models.

Imports the rooms of processes and observations.
"""
