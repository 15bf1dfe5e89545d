"""docs/reliability.md says of each public function and option what could make it wrong without a word."""

import inspect
import re
from pathlib import Path

import pytest
import typer.main

import zoomjax as zj
from zoomjax.app.cli import app

PAGE = (Path(__file__).parents[1] / "docs" / "reliability.md").read_text()
SAID = set(re.findall(r"[`.]([a-z_0-9]+)`", PAGE))
ROOMS = (
    "correct",
    "detect",
    "fit",
    "focal",
    "interop",
    "io",
    "lines",
    "models",
    "scenes",
    "tracks",
    "trust",
)


@pytest.mark.parametrize("room", ROOMS)
def test_each_public_function_is_on_the_page(room):
    door = getattr(zj, room)
    functions = {
        name for name in dir(door) if inspect.isfunction(getattr(door, name)) or _wrapped(door, name)
    }
    assert not {name for name in functions if not name.startswith("_")} - SAID


def _wrapped(door, name):
    """Compiled functions are callable objects."""
    found = getattr(door, name)
    return callable(found) and not inspect.isclass(found) and name.islower()


def test_each_option_is_on_the_page():
    commands = typer.main.get_command(app).commands.values()
    options = {
        option
        for command in commands
        for parameter in command.params
        for option in parameter.opts
        if option.startswith("--")
    }
    named = set(re.findall(r"--[a-z-]+", PAGE.partition("## By option")[2]))
    assert not options - named - {"--help", "--install-completion", "--show-completion"}
