"""The command line ``i2rl``.

Imports every room of the package.
"""
