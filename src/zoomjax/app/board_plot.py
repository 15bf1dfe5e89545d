"""A picture of boards that are bent."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..fit.boards import BoardFit

_MOST = 6
"""Boards that are drawn, at most."""


def plot_boards(fit: BoardFit, zooms: Sequence[str] = ()) -> Figure:
    """Height of each board's corners over its plane, as the camera sees it: blue is nearer.

    `zooms` are the names of the focal lengths that the boards were seen at, if each has one of its own.
    """
    height = -np.asarray(fit.shape)[:_MOST, ..., 2]
    across = 1.2 + 3.3 * min(len(height), 3)
    figure = Figure(figsize=(across, 3 if len(height) <= 3 else 5.5), layout="constrained")
    rows = 1 if len(height) <= 3 else 2
    axes = figure.subplots(rows, -(-len(height) // rows), squeeze=False).ravel()
    most = max(float(np.abs(height).max()), 1e-6)
    drawn = None
    for number, (own, of) in enumerate(zip(axes, height, strict=False)):
        drawn = own.imshow(of, cmap="RdBu", vmin=-most, vmax=most, interpolation="bicubic")
        photos = int(np.sum(np.asarray(fit.board) == number))
        title = f"{photos} photos: {fit.bend[number]:.2f} steps"
        if number < len(zooms):
            title = f"{zooms[number]}, {title}"
        own.set(xticks=[], yticks=[])
        own.set_title(title, fontsize=10)
    for own in axes[len(height) :]:
        own.remove()
    assert drawn is not None  # there is one board at least
    figure.colorbar(drawn, ax=axes[: len(height)].tolist(), label="towards the camera, steps of the grid")
    return figure
