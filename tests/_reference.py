"""Plain NumPy versions of the paper's formulas, and comparisons of derivatives."""

import jax
import jax.numpy as jnp
import numpy as np


def undistorted(points, k, centre, scale):
    """Eq. 1-2, as printed."""
    points, k, centre, scale = (np.asarray(argument) for argument in (points, k, centre, scale))
    z = (points - centre) / scale
    r2 = np.sum(z**2, axis=-1, keepdims=True)
    return centre + scale * z * (1 + sum(k_i * r2 ** (i + 1) for i, k_i in enumerate(k)))


def squared_distances(points):
    """Squared distances of points to their total-least-squares line, by singular values."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][-1]
    return (centred @ normal) ** 2


def frame_energies(lines, coefficients):
    """Eq. 3: for each frame the mean over its lines of the mean squared distance."""
    frames = np.asarray(lines.frame)
    errors = [
        squared_distances(undistorted(line, coefficients[frame], lines.centre, lines.scale)).mean()
        for line, frame in zip(lines.to_ragged(), frames, strict=True)
    ]
    return np.array([np.mean(np.array(errors)[frames == m]) for m in range(len(lines.focal))])


def fold_radius(k):
    """The least radius at which the slope of ``r L(r^2)`` is zero, by eigenvalues."""
    slope = [1, *((2 * i + 3) * k_i for i, k_i in enumerate(k))]
    roots = np.roots(slope[::-1])
    real = roots[np.abs(roots.imag) < 1e-12 * np.abs(roots)].real
    return np.sqrt(np.min(real[real > 0], initial=np.inf))


def finite_jacobian(function, x, step):
    """Central differences of an array function of one array, jacfwd's layout."""
    x = np.asarray(x, np.float64)
    columns = []
    for index in np.ndindex(x.shape):
        offset = np.zeros_like(x)
        offset[index] = step
        difference = np.asarray(function(jnp.asarray(x + offset))) - function(jnp.asarray(x - offset))
        columns.append(difference / (2 * step))
    return np.moveaxis(columns, 0, -1).reshape(*columns[0].shape, *x.shape)


def assert_derivatives_agree(function, x, *, step, rtol=1e-6, atol=1e-9):
    """Forward = reverse (to rounding) = finite differences (to `rtol` of the largest)."""
    x = jnp.asarray(x)
    compiled = jax.jit(lambda x: function(x))
    forward, reverse = jax.jit(jax.jacfwd(compiled))(x), jax.jit(jax.jacrev(compiled))(x)
    size = float(np.max(np.abs(forward), initial=0.0))
    assert np.isfinite(size)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-11 * size + 1e-14)
    finite = finite_jacobian(compiled, x, step)
    np.testing.assert_allclose(forward, finite, rtol=0, atol=rtol * size + atol)


def image_grid(size, number=20):
    """Points all over an image, its corners among them."""
    x, y = (np.linspace(0, side - 1, number) for side in size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def largest_difference(lens, other, focal):
    """Largest distance, px, between what two lenses correct an image point to, over focal lengths."""
    grid = jnp.asarray(image_grid(lens.image_size))

    def difference(f):
        return jnp.linalg.norm(lens(f).undistort(grid) - other(f).undistort(grid), axis=-1)

    return float(jnp.max(jax.vmap(difference)(jnp.asarray(focal))))
