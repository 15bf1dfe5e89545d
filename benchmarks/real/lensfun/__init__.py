"""Six hundred real zoom lenses: which zoom model predicts a focal length that was left out?

The lensfun database (through the package `lensfunpy`, CC BY-SA 3.0; none of it is stored here) holds zoom
lenses that people calibrated by hand at several focal lengths. 15 upright and 10 level straight lines of
the scene are seen through each lens at each focal length, in images of 4288 x 2848 px, and every zoom model
of zoomjax is fitted to them: to all focal lengths, and to all but one interior one, on which it is tested.

The prior of `SmoothZoom` is learned here, from half of the lenses for the other half; a lens that is in the
database under several names, or whose table is, is in one half only. So is that of `SmoothZoom.for_lens`,
which knows the ends of each lens's range and the crop factor. `--prior` learns both from all instead and
prints the numbers that `zoomjax/models/smooth.py` has.

Once: lines, their compression, each frame's own optimum, and the second derivatives of its energy. Fits of
models linear in their parameters then are least squares of the frames' coefficients in that metric, which
have the answer without each frame in closed form, all lenses at once. What is reported is the true energy
of the lines left out; how far such fits are from `zoomjax.fit_zoom`, one by one, is measured too.

`data` reads the lenses and makes lines, `models` fits them, `prior` learns, `few` fits a few focal lengths,
`study` compares, `page` tells.
"""
