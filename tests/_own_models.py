"""A zoom model and a distortion model as users write them."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj


@zj.models.register_model
class LogZoom(zj.models.AbstractLinearZoom):
    """Each coefficient a polynomial in log(f / start), times fixed factors."""

    formula: ClassVar[str] = "k_i(f) = sum_j parameters[j][i-1] (log(f / start))^powers[j]"

    powers: tuple[int, ...] = eqx.field(static=True, default=(0, 1))
    parameters: jax.Array | None = None
    start: jax.Array | None = None

    def prepare(self, focal, terms):
        return LogZoom(self.powers, jnp.zeros((len(self.powers), terms)), jnp.min(jnp.asarray(focal)))

    def basis(self, focal):
        return jnp.stack([jnp.log(focal / self.start) ** power for power in self.powers])

    def basis_pieces(self, focal_range):
        if self.powers != (0, 1):
            return None
        low, high = jnp.log(jnp.asarray(focal_range) / self.start)
        controls = jnp.stack([jnp.ones(2), jnp.stack([low, high])], axis=1)
        ends = jnp.stack([low, high]) + jnp.log(self.start)
        return zj.models.Pieces(controls[None], ends[None], jnp.exp, jnp.max(jnp.abs(controls), axis=0))


@zj.models.register_model(name="half-polynomial")
class Halved(zj.models.AbstractRadial):
    """The radial polynomial of half of the coefficients."""

    formula: ClassVar[str] = "corrected = centre + z * scale * (1 + (k1 r^2 + ... + kN r^2N) / 2)"

    def factor(self, squared, k):
        return zj.models.RadialPolynomial().factor(squared, k / 2)

    def slope(self, squared, k):
        return zj.models.RadialPolynomial().slope(squared, k / 2)

    def equation(self, r, squared, rho, k):
        return zj.models.RadialPolynomial().equation(r, squared, rho, k / 2)

    def conditions(self, number):
        return zj.models.RadialPolynomial().conditions(number) / 2

    def expansion_terms(self, number):
        return number

    def expansion(self, k, reach):
        return k / 2, k[:0]


def own_lens() -> zj.ZoomLens:
    zoom = LogZoom(parameters=jnp.array([[0.02, 0.01], [-0.1, 0.03]]), start=jnp.asarray(20.0))
    centre, ends = jnp.array([319.5, 239.5]), np.array([20.0, 80.0])
    return zj.ZoomLens(zoom, centre, jnp.asarray(ends), (640, 480), distortion_model=Halved())
