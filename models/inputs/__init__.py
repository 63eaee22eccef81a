"""Values from outside: numbers of any library, random keys, text and archives, each checked once.

Imports nothing of this package. Imported by every other room.
"""
