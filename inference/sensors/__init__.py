"""The M-step of a sensor: its reliabilities and confusions given a session's observations.

Imports the rooms of programs, sessions and completion.
"""
