"""Six hundred real zoom lenses: which zoom model predicts a focal length that was left out?

pip install '.[bench]'
python -m benchmarks.real.lensfun [--output FILE] [--prior | --forms]
"""

import argparse
import importlib.metadata
import json
from pathlib import Path

import jax

from ...shared import RESULTS, machine
from .page import markdown
from .prior import print_forms, print_prior
from .study import study


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "lensfun.md")
    parser.add_argument("--prior", action="store_true", help="learn the prior from all lenses and print it")
    parser.add_argument("--forms", action="store_true", help="compare degrees of SmoothZoom and print them")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.prior:
        print_prior()
    elif options.forms:
        print_forms()
    else:
        versions = {"lensfunpy": importlib.metadata.version("lensfunpy")}
        measured = {"machine": machine() | versions, **study()}
        options.output.write_text(markdown(measured))
        options.output.with_suffix(".json").write_text(json.dumps(measured, indent=1) + "\n")
        print(options.output.read_text())


if __name__ == "__main__":
    main()
