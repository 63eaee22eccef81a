"""Measurements of speed, memory and statistical behaviour; run by ``make bench``."""
