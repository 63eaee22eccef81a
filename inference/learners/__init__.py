"""Learners of rewards as weights of features, one function per method, and the baselines.

Imports the rooms of mixtures, sensors, sessions, programs and completion.
"""
