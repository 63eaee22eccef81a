"""Compare the online methods of others with this library's (Table 8.1).

Imports the rooms of judging, drawing, bounds and posteriors.
"""
