"""Posteriors over weights, components and reliabilities by NUTS and Gibbs sampling, as ``InferenceData``.

Imports the rooms of learners and completion.
"""
