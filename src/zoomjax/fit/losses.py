"""Where the losses of a fit to a clip begin to flatten, and from where they nearly ignore a residual."""

CAUCHY = 2.3849
"""Of the noise: where the loss of a view begins to flatten; of normal errors it wastes a twentieth."""

IGNORED = 3.0
"""Times that: views beyond do not follow the model."""

LINE = 3.0
"""Of the noise of lines: the RMS of a line's distances where its loss begins to flatten."""

IGNORED_LINE = 3 * LINE
"""Beyond, a line hardly counts."""
