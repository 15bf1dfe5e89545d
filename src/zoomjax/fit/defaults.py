"""What a fit takes where it is not told."""

from ..models.zoom import AbstractZoom, PolynomialZoom

DEFAULT_ZOOM = PolynomialZoom(degree=2)
"""The paper's: with `DEFAULT_TERMS` coefficients six numbers."""

DEFAULT_TERMS = 2


def zoom_or_default(zoom: AbstractZoom | None) -> AbstractZoom:
    """A zoom model that was given, or the default one."""
    return DEFAULT_ZOOM if zoom is None else zoom
