"""Settings of JAX for a command: float64, and a cache on disk for compiled programs."""

import logging

from ..fit.compiled import cache_compiled


def set_up_jax() -> None:
    """Compute in float64, and cache compiled programs on disk.

    A program that cannot be cached or read is compiled again, without a warning.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    cache_compiled()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # no messages about fonts and its own folders
