"""Measure label bias (Table 5.1): does a likelier trajectory earn more?

Imports the rooms of judging, drawing, bounds and posteriors.
"""
