"""Durable sessions: every session committed whole to an SQLite file, or not at all.

Imports :mod:`i2rl.inference.sessions`.
"""
