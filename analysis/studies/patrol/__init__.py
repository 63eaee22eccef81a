"""Study of a patrol: learn its rewards online through a keyhole, and walk past the patrollers undetected.

Imports the rooms of judging, drawing, bounds and posteriors.
"""
