"""Version of the package, in a module of its own so that the build reads it without other imports."""

__version__ = "0.1.0"
