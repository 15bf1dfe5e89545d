"""Settings of JAX for a command: float64, a cache on disk for compiled programs, and few sizes of these."""

import logging

from ..fit.compiled import cache_compiled


def set_up_jax() -> None:
    """Compute in float64, cache compiled programs on disk, and make these for a process that runs once.

    A program that cannot be cached or read is compiled again, without a warning.
    """
    import jax

    from .._core.programs import use_once

    jax.config.update("jax_enable_x64", True)
    cache_compiled()
    use_once()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # no messages about fonts and its own folders
