"""What a fit takes where it is not told."""

from ..models.zoom import AbstractZoom, PolynomialZoom

DEFAULT_ZOOM = PolynomialZoom(degree=2)
"""The paper's: with two coefficients six numbers."""


def zoom_or_default(zoom: AbstractZoom | None) -> AbstractZoom:
    """A zoom model that was given, or the default one."""
    return DEFAULT_ZOOM if zoom is None else zoom
