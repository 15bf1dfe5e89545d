"""Other Pythons, which have what this one cannot: packages of Debian, and Blender."""

import functools
import json
import os
import subprocess
from pathlib import Path

import pytest

NAMES = ("python3", "python3.11")


@functools.cache
def _found(module, named):
    places = (Path(folder) / name for folder in os.get_exec_path() for name in NAMES)
    for path in [Path(named)] if named else places:
        if (
            path.exists()
            and not subprocess.run([path, "-c", f"import {module}"], capture_output=True).returncode
        ):
            return str(path)
    return None


def python_with(module, install, variable=None):
    """A Python that imports a module: that of an environment variable, else on the path; else skip."""
    if (found := _found(module, os.environ.get(variable or ""))) is None:
        here = f", or {variable}=/its/bin/python" if variable else ""
        pytest.skip(f"Needs {module} ({install}) for a python3 on the path{here}.")
    return found


def run(python, program, *given):
    """What the program printed, given these as JSON."""
    done = subprocess.run([python, "-c", program], input=json.dumps(given), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout
