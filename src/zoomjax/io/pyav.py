"""PyAV, imported when it is first used: modules that need it only for video are imported without it."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import av
    import av.codec.codec
    import av.error
    import av.logging
    import av.sidedata.sidedata
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

__all__ = ["av"]
