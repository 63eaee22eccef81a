"""Learn a patrol's rewards online through a keyhole, and walk past the patrollers unseen.

Imports the rooms of judging, drawing, bounds and posteriors.
"""
