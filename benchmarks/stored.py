"""Run a benchmark that prints its figures, and store what it prints as a page of results.

    python -m benchmarks.stored NAME MODULE [ARGUMENT ...]

    python -m benchmarks.stored focal real.pitch
    python -m benchmarks.stored lensfun-forms real.lensfun --forms

The page is benchmarks/results/NAME.md, with the command and the machine; nothing is stored if the benchmark
fails.
"""

import argparse
import importlib
import subprocess
import sys

from .shared import RESULTS, machine, machine_line


def main() -> None:
    """Run, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name")
    parser.add_argument("module")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    module = f"benchmarks.{options.module}"
    command = [sys.executable, "-m", module, *options.arguments]
    printed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    shown = " ".join(["python", "-m", module, *options.arguments])
    about = (importlib.import_module(module).__doc__ or "").splitlines()[0]
    parts = [f"# {about.rstrip('.')}", f"`{shown}`:", f"```text\n{printed.strip()}\n```"]
    page = "\n\n".join([*parts, machine_line(machine())]) + "\n"
    (RESULTS / f"{options.name}.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
