"""Photos turned by half a turn, of which no tag tells."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.turned import findings_of_turned

SIZE = (1200, 800)
MIDDLE = (np.array(SIZE) - 1) / 2
NAMES = [f"{number}.jpg" for number in range(8)]


def photographed(off, turned):
    """Lines of a board in eight photos by a lens whose centre is so far off the middle, some turned."""
    zoom = zj.PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.0], [-0.1, 0.02]]), jnp.array(20.0))
    lens = zj.ZoomLens(zoom, jnp.asarray(MIDDLE + off), jnp.array([20.0, 60.0]), SIZE, "mm")
    focal = scenes.focal_sweep(len(NAMES), 20, 60)
    lines = scenes.board_lines(lens, focal, board=scenes.StripedBoard.before(lens), noise=0.1, spacing=40)
    points = np.array(lines.points)
    which = np.isin(np.asarray(lines.frame), turned)
    points[which] = np.where(np.asarray(lines.mask)[which][..., None], 2 * MIDDLE - points[which], 0)
    return eqx.tree_at(lambda one: one.points, lines, jnp.asarray(points))


def found(off, turned):
    lines = photographed(np.array(off), turned)
    small = zj.lines.compress_any_centre(lines, terms=2)
    lens = zj.fit.fit_centre(small, zoom=zj.PolynomialZoom(2)).fit.lens
    return findings_of_turned(lines, lens, NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [[0, 2], [1, 3, 5, 7], [0]])
def test_turned_photos_are_said(turned):
    """With a centre 54 px off the middle. At long focal lengths there is nothing to see, and no harm."""
    (finding,) = found((45.0, -30.0), turned)
    assert finding.verdict == "doubtful"
    told = {frame for frame, name in enumerate(NAMES) if name in finding.found.rpartition(": ")[2]}
    assert told
    assert told <= set(turned) or told.isdisjoint(turned)  # which of them were turned nobody knows


@pytest.mark.parametrize(
    ("off", "turned"), [((45.0, -30.0), []), ((6.0, 4.0), []), ((0.0, 0.0), [1, 3]), ((-80.0, 50.0), [])]
)
def test_photos_that_are_not_turned_are_not(off, turned):
    assert found(off, turned) == []
