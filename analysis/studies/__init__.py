"""Experiments of the dissertation: one room a study."""
