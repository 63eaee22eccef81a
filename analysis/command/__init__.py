"""Command line ``i2rl``.

Imports every room of the package.
"""
