"""The library of lenses: how near its zooms are to the lensfun database, and how long they take to load.

    python -m benchmarks.lenses [--output FILE]

Every zoom of the database is loaded in one process, in float64, for images of 4288 x 2848 px of the sensor
that it was calibrated on, compiling included; then those that the database has for sensors of crop factor 1
and 1.5. The error is the greatest distance in the distorted image from where lensfun puts a point, over the
image and all focal lengths, at the best magnification of each (`table_error_px`); tests/interop compares it
with lensfun's own code. Results go to benchmarks/results/lenses.md and lenses.json.
"""

import argparse
import os
import time
from pathlib import Path

import jax
import numpy as np

import zoomjax as zj

from .shared import RESULTS, machine, machine_line, table, write

SIZE = (4288, 2848)
QUANTILES = (0.5, 0.9, 0.99, 1.0)

FAR = 2.0
"""px from which lenses are named."""


def loaded(crop: float | None) -> dict:
    """All zooms for one crop factor; those of smaller sensors are left out."""
    wall, processor = time.perf_counter(), time.process_time()
    lenses, refused = [], 0
    for entry in zj.interop.find_lenses(zooms=True):
        try:
            lenses.append(zj.interop.library_lens(entry, image_size=SIZE, crop=crop))
        except ValueError:
            refused += 1
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    errors = np.array([lens.about["table_error_px"] for lens in lenses])
    far = {lenses[i].about["lens"]: errors[i] for i in np.argsort(-errors) if errors[i] > FAR}
    return {
        "lenses": len(lenses),
        "refused": refused,
        "smooth": sum(isinstance(lens.zoom, zj.SmoothZoom) for lens in lenses),
        "error": np.quantile(errors, QUANTILES).tolist(),
        "far": far,
        "seconds": wall,
        "processor": processor,
    }


def page(results: dict) -> str:
    """The results as Markdown."""
    rows = [
        [
            name,
            str(part["lenses"]),
            str(part["smooth"]),
            *(f"{error:.2f}" for error in part["error"]),
            f"{part['processor']:.1f}",
            f"{part['seconds']:.1f}",
        ]
        for name, part in results["crops"].items()
    ]
    header = [
        "sensor",
        "zooms",
        "`SmoothZoom`",
        "median, px",
        "90 %, px",
        "99 %, px",
        "worst, px",
        "processor, s",
        "clock, s",
    ]
    first = next(iter(results["crops"].values()))
    far = ", ".join(f"{name} ({error:.1f} px)" for name, error in first["far"].items())
    return "\n".join(
        [
            "# The library of lenses",
            "",
            "Made by `python -m benchmarks.lenses`, which says what is measured.",
            "",
            *table(header, rows),
            "",
            "Every lens is certified invertible; one that is not is refused. "
            f"Farther than {FAR:g} px are {far}. The first row compiles.",
            "",
            f"{machine_line(results['machine'])} Load average at the end: {results['load']:.1f}.",
            "",
        ]
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "lenses.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    crops = {"as calibrated": loaded(None), "crop factor 1": loaded(1.0), "crop factor 1.5": loaded(1.5)}
    results = {"machine": machine(), "load": os.getloadavg()[0], "crops": crops}
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
