"""The M-step of a sensor: what a session's observations say of its reliabilities and confusions.

Imports the rooms of programs, sessions and completion.
"""
