"""Sort onions in several ways at once (Figure 7.8, Table 7.2).

Imports the rooms of judging, drawing, bounds and posteriors.
"""
