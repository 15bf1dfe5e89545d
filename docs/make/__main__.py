"""``python -m docs.make tables | rooms | site``: see the modules of these names."""

import argparse
from pathlib import Path

from . import rooms, site, tables


def main() -> None:
    """Run one of the commands."""
    parser = argparse.ArgumentParser(prog="python -m docs.make", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("tables", help="write the tables in README and docs from benchmarks/results")
    commands.add_parser("rooms", help="draw docs/figures/rooms.svg from the imports of src")
    build = commands.add_parser("site", help="build the documentation into a folder that opens offline")
    build.add_argument("-o", "--output", type=Path, default=Path("build/site"), help="build/site")
    options = parser.parse_args()
    if options.command == "site":
        print(site.build(options.output))
    else:
        for path in {"tables": tables.update, "rooms": rooms.update}[options.command]():
            print(path)


if __name__ == "__main__":
    main()
