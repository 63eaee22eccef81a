"""``python -m i2rl`` is the command ``i2rl``."""

from .analysis.command.app import main

main()
