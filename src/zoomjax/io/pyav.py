"""PyAV, imported when it is first used: modules that need it only for video are imported without it."""

import os
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import av
    import av.codec.codec
    import av.error
    import av.logging
    import av.sidedata.sidedata
    import av.stream
else:

    class _PyAV:
        """The module `av`; where it is not installed, the first use says how to get it."""

        def __getattr__(self, name: str) -> Any:
            try:
                import av
            except ModuleNotFoundError as error:
                raise ModuleNotFoundError('Video needs PyAV: pip install "zoomjax[app]"') from error
            return getattr(av, name)

    av = _PyAV()

__all__ = ["av", "open_container"]


def open_container(path: str | os.PathLike[str], mode: Literal["r", "w"] = "r", **more: Any) -> Any:
    """A file as a container of PyAV's, whose tags need not be UTF-8: other bytes are surrogates."""
    if int(av.__version__.partition(".")[0]) < 19:  # later ones do so by themselves
        more["metadata_errors"] = "surrogateescape"
    return av.open(os.fspath(path), mode, **more)
