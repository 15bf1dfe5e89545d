"""What benchmarks share: where their pages lie, what they were measured on, and where real data is."""

import argparse
import importlib.metadata
import json
import os
import platform
from collections.abc import Iterable
from pathlib import Path

import jax
import psutil

RESULTS = Path(__file__).parent / "results"

_PACKAGES = ("zoomjax", "jax", "jaxlib", "optimistix", "equinox", "numpy", "scipy")


def machine() -> dict:
    """What the figures were measured on."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        names = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "memory_GB": round(psutil.virtual_memory().total / 1e9),
        "device": str(jax.devices()[0]),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
    }


def machine_line(machine: dict) -> str:
    """One sentence of `machine` for a page."""
    packages = ", ".join(f"{name} {machine[name]}" for name in _PACKAGES)
    return (
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_GB']} GB; Python "
        f"{machine['python']}, {packages}; on {machine['device']}."
    )


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """A Markdown table, its first column text and the others numbers."""
    header = list(header)
    return [
        f"| {' | '.join(header)} |",
        f"|---|{'---:|' * (len(header) - 1)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def write(output: Path, page: str, results: dict, *, quiet: bool = False) -> None:
    """Print a page, and write it with its results beside it as JSON."""
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(page)
    output.with_suffix(".json").write_text(json.dumps(results, indent=2) + "\n")
    if not quiet:
        print(page)


def real_data(parser: argparse.ArgumentParser) -> Path:
    """The folder of real data, or an error of the command line."""
    if "ZOOMJAX_DATA" not in os.environ:
        parser.error("set the environment variable ZOOMJAX_DATA to the folder of real data")
    return Path(os.environ["ZOOMJAX_DATA"])
