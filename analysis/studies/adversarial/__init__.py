"""Learn adversarially from noisy recordings (Tables 7.3 and 7.4, Figures 7.11 to 7.13).

Imports the rooms of judging, drawing, bounds and posteriors.
"""
