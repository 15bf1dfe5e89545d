"""Settings of JAX: float64, and a cache on disk for compiled programs."""

import contextlib
import glob
import logging
import os
import re
import shutil
from pathlib import Path

from .._core.files import cache_folder

_MOST_COMPILED = 100_000_000  # bytes; a run with new shapes adds about a million


def set_up_jax() -> None:
    """Compute in float64, and cache compiled programs on disk: compiling takes most of a short run.

    A program that cannot be cached or read is compiled again, without a warning.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = cache_folder("compiled")
    if folder and "JAX_COMPILATION_CACHE_DIR" not in os.environ and _can_write(folder):
        _remove_torn(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MOST_COMPILED)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.03)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # no messages about fonts and its own folders


def _can_write(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder.is_dir() and os.access(folder, os.W_OK)


def _remove_torn(folder: Path) -> None:
    """Remove programs without the file that says when they were used: beside one, JAX keeps no other."""
    with contextlib.suppress(OSError):
        names = set(os.listdir(folder))
        programs = {name.removesuffix("-cache") for name in names if name.endswith("-cache")}
        for program in programs:
            if f"{program}-atime" not in names or (folder / f"{program}-cache").is_dir():
                forget_compiled(program)


UNKEPT = re.compile(r"Error (?:reading|writing) persistent compilation cache entry for '([^']*)'")


def forget_compiled(name: str) -> None:
    """Remove the cached files of a program: JAX does not replace a file cut off by a full disk."""
    folder = cache_folder("compiled")
    for path in folder.glob(f"{glob.escape(name)}-*") if folder else ():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
