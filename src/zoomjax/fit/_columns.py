"""Unknowns and rows of `fit_motion`, and the Jacobian's columns, made for few views at a time.

Each view depends on the four numbers of its frame, on the two or three of its ray, and on the lens. All
columns are 288 bytes a view with the usual lens: they are never there for all views at once. What is summed
over the views grows from chunk to chunk of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

CHUNK = 1024
"""Views that are looked at together: what that takes stays in a core's cache."""


class Unknowns(NamedTuple):
    """What is solved for.

    Attributes:
        frames: four numbers a frame: log f, and a rotation vector.
        rays: two numbers a ray, or three: the third is its lever.
        lens: a tree of arrays.
    """

    frames: Float[Array, "frame 4"]
    rays: Float[Array, "track own"]
    lens: PyTree


class Rows(NamedTuple):
    """Residuals: of the views, and of what is known beforehand of frames and lens.

    Attributes:
        views: of each view; they depend on its frame, its ray and the lens.
        lines: of each line; they depend on its frame and the lens.
        frames: of each frame, a number for each of its own; each depends on that one and the lens.
        lens: of the lens alone.
        rays: of each ray alone; None if nothing is known beforehand.
    """

    views: Float[Array, "view 2"]
    lines: Float[Array, "line some"]
    frames: Float[Array, "frame 4"]
    lens: Float[Array, "row"]
    rays: Float[Array, "track known"] | None = None


class Columns(NamedTuple):
    """The Jacobian's columns.

    Attributes:
        of_views: gives those of views from their numbers, (view, 2, unknown): by the numbers of the frame,
            of the ray, and of the lens.
        by_frame, by_ray, by_lens: those of the other rows, the last axis; `Rows.views` has no view.
    """

    of_views: Callable[[Int[Array, "some"]], Float[Array, "some 2 unknown"]]
    by_frame: Rows
    by_ray: Rows
    by_lens: Rows

    def split(self, number: Int[Array, "some"], there: Bool[Array, "some"]) -> tuple[Array, Array, Array]:
        """Columns of views by frame, by ray and by lens; 0 for those that are not there."""
        # In a loop: otherwise XLA makes them again for each product that they are in.
        parts = number.reshape(2 if len(number) % 2 == 0 else 1, -1)
        found = jax.lax.map(self.of_views, parts).reshape(len(number), 2, -1)
        found = jnp.where(there[:, None, None], found, 0)
        ray = 4 + self.by_ray.lens.shape[-1]
        return found[..., :4], found[..., 4:ray], found[..., ray:]


def columns(jacobian: Any, like: Unknowns) -> Columns:
    """The columns of a Jacobian that maps `Unknowns` to `Rows`; those of all views are made at once."""
    parts = derivatives(jacobian, like)
    by_frame, by_ray, by_lens = (part._replace(views=jnp.zeros((0, 2, 0))) for part in parts)
    views = jnp.concatenate([part.views for part in parts], axis=-1)
    own = jnp.diagonal(by_frame.frames, axis1=1, axis2=2)
    return Columns(lambda number: views[number], by_frame._replace(frames=own), by_ray, by_lens)


def derivatives(jacobian: Any, like: Unknowns) -> tuple[Any, Any, Any]:
    """What each number of all frames, each of all rays, and each of the lens does; the last axis.

    That is enough for what belongs to one frame and one ray, at most.
    """
    lens, unravel = ravel_pytree(like.lens)
    ray = slice(4, 4 + like.rays.shape[1])

    def column(along):
        frames, rays = (
            jnp.broadcast_to(along[part], of.shape)
            for part, of in ((slice(4), like.frames), (ray, like.rays))
        )
        return jacobian(Unknowns(frames, rays, unravel(along[ray.stop :])))

    # One after the other: all at once take longer, as what they need does not fit a cache.
    out = jax.lax.map(column, jnp.eye(ray.stop + lens.size))

    def those(part):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf[part], 0, -1), out)

    return those(slice(4)), those(ray), those(slice(ray.stop, None))


def over_views(
    views: int, step: Callable[[Any, Array, Array], tuple[Any, PyTree]], start: Any
) -> tuple[Any, PyTree]:
    """Goes through views chunk by chunk.

    Args:
        views: their number.
        step: from what is summed, the numbers of some views and which of these there are, to what is summed
            with them, and what each of them gives.
        start: of what is summed.

    Returns:
        What is summed in the end, and what each view gives.
    """
    size = max(min(CHUNK, views), 1)

    def chunk(state, first):
        number = first + jnp.arange(size)
        return step(state, jnp.minimum(number, views - 1), number < views)

    state, each = jax.lax.scan(chunk, start, jnp.arange(0, views, size))
    return state, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:views], each)


def of_each(views: int, of: Callable[[Array], PyTree]) -> PyTree:
    """What a function of the numbers of some views gives for all of them, made chunk by chunk."""
    return over_views(views, lambda state, number, _: (state, of(number)), None)[1]
