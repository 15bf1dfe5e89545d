"""Numbers of other kinds than JAX's: those of other libraries are read, what are no numbers is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.fit import frame_energy, global_energy, residuals

pytestmark = pytest.mark.usefixtures("unchecked")

T = np.linspace(0.0, 479.0, 9)
LINES = [
    np.stack([x + 100 / f * (x / 320 - 1) * (T / 240 - 1) ** 2, T], -1) for f in (24, 50) for x in (9, 599)
]
FRAME, FOCAL = np.repeat(np.arange(2), 2), np.array([24.0, 50.0])
GIVEN = zj.Lines.from_ragged(LINES, FRAME, FOCAL, image_size=(640, 480))
COEFFICIENTS = np.array([[0.1, 0.0], [0.05, 0.01]])
SPANS = "timedelta64[s]"


@dataclasses.dataclass
class Column:
    """A column of another library: it has a dtype that NumPy does not know."""

    values: np.ndarray
    dtype: str = "Float64"

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype)


def like(values, kind):
    """The same numbers in another form."""
    forms = {
        "column": lambda: Column(values),
        "big-endian": lambda: values.astype(values.dtype.newbyteorder(">")),
        "long double": lambda: values.astype(np.longdouble),
        "list": values.tolist,
    }
    return forms[kind]()


@pytest.mark.parametrize("kind", ["column", "big-endian", "long double", "list"])
@pytest.mark.parametrize("function", [zj.frame_rms, frame_energy, global_energy, residuals])
def test_coefficients_are_read(function, kind):
    if function is zj.frame_rms and kind in ("column", "list"):
        with pytest.raises(TypeError, match="Argument lens must be a ZoomLens"):
            function(GIVEN, like(COEFFICIENTS, kind))
        return
    np.testing.assert_array_equal(
        function(GIVEN, like(COEFFICIENTS, kind)), function(GIVEN, jnp.asarray(COEFFICIENTS))
    )


@pytest.mark.parametrize("wrong", [complex, bool, str, object, SPANS])
@pytest.mark.parametrize("function", [zj.frame_rms, frame_energy, global_energy, residuals])
def test_coefficients_that_are_no_real_numbers_are_refused(function, wrong):
    values = COEFFICIENTS.astype(int if wrong == SPANS else float).astype(wrong)
    with pytest.raises(ValueError, match="must hold real numbers"):
        function(GIVEN, values)


@pytest.mark.parametrize("kind", ["column", "big-endian", "long double"])
def test_lines_are_read(kind):
    read = zj.Lines.from_ragged(
        [like(line, kind) for line in LINES], FRAME, like(FOCAL, kind), image_size=(640, 480)
    )
    np.testing.assert_array_equal(read.points, GIVEN.points)
    made = zj.Lines(
        points=like(np.asarray(GIVEN.points), kind),
        mask=GIVEN.mask,
        frame=GIVEN.frame,
        focal=like(FOCAL, kind),
        centre=like(np.array([319.5, 239.5]), kind),
        image_size=(640, 480),
    )
    np.testing.assert_array_equal(zj.frame_rms(made, None), zj.frame_rms(GIVEN, None))


def test_spans_of_time_are_no_numbers():
    with pytest.raises(ValueError, match="focal"):
        zj.Lines.from_ragged(LINES, FRAME, FOCAL.astype(int).astype(SPANS), image_size=(640, 480))
    with pytest.raises(ValueError, match=r"points must hold real numbers.*timedelta"):
        zj.Distortion(jnp.array([0.1]), jnp.array([319.5, 239.5]), jnp.array(400.0)).undistort(
            LINES[0].astype(int).astype(SPANS)
        )


@pytest.mark.parametrize("wrong", [object, str, np.longdouble, SPANS])
def test_images_of_no_numbers_are_refused(wrong):
    distortion = zj.Distortion(jnp.array([0.1]), jnp.array([2.5, 1.5]), jnp.array(3.6))
    with pytest.raises(ValueError, match="must hold real numbers"):
        zj.warp_image(np.ones((4, 6), int).astype(wrong), distortion)


def test_an_image_of_another_library_is_refused():
    distortion = zj.Distortion(jnp.array([0.1]), jnp.array([2.5, 1.5]), jnp.array(3.6))
    image = Column(np.ones((4, 6)))
    image.ndim, image.shape = 2, (4, 6)
    with pytest.raises(ValueError, match="must be an array, but it is a Column"):
        zj.warp_image(image, distortion)
