"""Learn through noisy perception (section 7.4.3).

Imports the rooms of judging, drawing, bounds and posteriors.
"""
