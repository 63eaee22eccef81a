"""Switch JAX to 64-bit floats: likelihoods of long trajectories and warm-started programs need the digits.

Packages whose modules compute with JAX import this first, so that any module of theirs is an entrance.
"""

import jax

jax.config.update("jax_enable_x64", True)
