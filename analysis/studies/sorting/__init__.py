"""Study of onion sorting with several behaviours (Figure 7.8, Table 7.2).

Imports the rooms of judging, drawing, bounds and posteriors.
"""
