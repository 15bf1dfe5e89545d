"""A cache on disk for programs: to trace, lower and compile them takes most of a short run."""

import contextlib
import glob
import importlib.util
import os
import re
import shutil
from pathlib import Path

from .._core.files import cache_folder

_MOST = 100_000_000  # bytes; all that one calibration compiles takes some ten million


def cache_compiled(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep what JAX compiles on disk, for all later processes: call it before the first fit.

    Data sets are padded to a few sizes, and those of one size share programs. So after some calibrations
    later ones compile almost nothing. Where the package ``flatbuffers`` is installed, with which JAX
    writes them, the traced programs of fits are kept, too, and later processes need not trace either. The
    command line does all this by itself. The folder is kept below 100 MB where the package ``filelock`` is
    installed, without which JAX cannot tell, and traced programs below 50 MB.

    Args:
        folder: where to; by default ``compiled`` in the folder ``ZOOMJAX_CACHE``, or in the user's cache.
            Of several calls the last one counts.

    Returns:
        The folder. None, and nothing is kept, if none can be written to. If ``JAX_COMPILATION_CACHE_DIR``
        is set, it is that folder, which stays as it is.

    Example:
        >>> import tempfile, jax
        >>> import zoomjax as zj
        >>> with tempfile.TemporaryDirectory() as folder:  # for this example alone
        ...     kept = zj.cache_compiled(folder)
        ...     kept.name in folder
        True
        >>> jax.config.update("jax_compilation_cache_dir", None)
    """
    import jax  # not needed to read this module, nor to remove a program
    from jax.experimental.compilation_cache import compilation_cache

    from .._core.kept import keep_programs

    if own := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(own)
    place = cache_folder("compiled") if folder is None else Path(folder).absolute()
    if place is None or not _can_write(place):
        return None
    _remove_torn(place)
    if getattr(jax.config, "jax_compilation_cache_dir", None) not in (None, str(place)):
        compilation_cache.reset_cache()  # or JAX goes on with the folder that it has opened
    jax.config.update("jax_compilation_cache_dir", str(place))
    if importlib.util.find_spec("filelock"):  # without it JAX warns, and keeps nothing
        jax.config.update("jax_compilation_cache_max_size", _MOST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.03)
    keep_programs(place)
    return place


def _can_write(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder.is_dir() and os.access(folder, os.W_OK)


def _remove_torn(folder: Path) -> None:
    """Remove programs without the file that says when they were used: beside one, JAX keeps no other."""
    with contextlib.suppress(OSError):
        names = set(os.listdir(folder))
        programs = {name.removesuffix("-cache") for name in names if name.endswith("-cache")}
        limited = any(name.endswith("-atime") for name in names)  # else there are no such files
        for program in programs:
            torn = limited and f"{program}-atime" not in names
            if torn or (folder / f"{program}-cache").is_dir():
                forget_compiled(program, folder)


UNKEPT = re.compile(r"Error (?:reading|writing) persistent compilation cache entry for '([^']*)'")


def forget_compiled(name: str, folder: Path | None = None) -> None:
    """Remove the cached files of a program: JAX does not replace a file cut off by a full disk."""
    folder = cache_folder("compiled") if folder is None else folder
    for path in folder.glob(f"{glob.escape(name)}-*") if folder else ():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
