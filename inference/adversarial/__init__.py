"""Adversarial learners of rewards and policies as networks, and their generators.

Needs the extra ``adversarial``. Imports the rooms of sessions and completion.
"""
