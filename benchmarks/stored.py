"""Run a script that prints its figures, and store what it prints as a page of results.

    python benchmarks/stored.py NAME SCRIPT [ARGUMENT ...]

    python benchmarks/stored.py focal real/pitch.py
    python benchmarks/stored.py lensfun-forms real/lensfun.py --forms

The page is benchmarks/results/NAME.md, with the command and the machine; nothing is stored if the script
fails.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from .shared import RESULTS, machine, machine_line

HERE = Path(__file__).parent


def main() -> None:
    """Run, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name")
    parser.add_argument("script")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    command = [sys.executable, str(HERE / options.script), *options.arguments]
    printed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    shown = " ".join(["python", f"benchmarks/{options.script}", *options.arguments])
    about = (HERE / options.script).read_text().split('"""')[1].splitlines()[0]
    parts = [f"# {about.rstrip('.')}", f"`{shown}`:", f"```text\n{printed.strip()}\n```"]
    page = "\n\n".join([*parts, machine_line(machine())]) + "\n"
    (RESULTS / f"{options.name}.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
