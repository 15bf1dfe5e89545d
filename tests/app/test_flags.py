"""What the library calls an argument is an option on the command line, which alone knows that."""

import ast
import re
from pathlib import Path

import pytest
import typer

import zoomjax
from zoomjax.app._flags import FLAGS, options_of, with_flags
from zoomjax.app.cli import app

ROOT = Path(zoomjax.__file__).parent
LIBRARY = [path for path in sorted(ROOT.rglob("*.py")) if path.relative_to(ROOT).parts[0] != "app"]

FLAG = re.compile(r"(?<![\w-])--[a-z]")


def said(path):
    """The strings of a source that are no documentation."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            yield node.value


@pytest.mark.parametrize("path", LIBRARY, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_the_library_knows_no_flags(path):
    assert not [text for text in said(path) if FLAG.search(text)]


def test_a_flag_in_an_error_would_be_found(tmp_path):
    path = tmp_path / "module.py"
    path.write_text('"""Run with --this."""\nraise ValueError(f"Give {1} (--hold).")\n')
    assert [text for text in said(path) if FLAG.search(text)] == [" (--hold)."]


def test_every_flag_is_an_option():
    commands = typer.main.get_command(app).commands.values()
    options = {name for command in commands for parameter in command.params for name in parameter.opts}
    assert set(FLAGS.values()) <= options


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ("Argument focal must be positive.", "--focal must be positive."),
        ("Argument focal_sigma must be positive.", "--focal-sigma must be positive."),
        (
            "Hold its ends (argument hold), or give argument focal.",
            "Hold its ends (--hold), or give --focal.",
        ),
        ("Argument target must end in .mp4.", "--output must end in .mp4."),
        ("Argument focal_range must increase.", "Argument focal_range must increase."),
        ("Cannot read a.npz: Argument focal must hold", "Cannot read a.npz: Argument focal must hold"),
    ],
)
def test_arguments_have_the_command_lines_names(message, told):
    assert with_flags(message) == told


LONGER = "Give a track as long as the video, or hold its ends (argument hold). Now."


@pytest.mark.parametrize(
    ("message", "words", "told"),
    [
        (
            LONGER,
            ["undistort", "lens.json"],
            "Give a track as long as the video, or hold its ends (--hold). Now.",
        ),
        (LONGER, ["calibrate", "a.mp4"], "Give a track as long as the video. Now."),
        (LONGER, ["--help"], "Give a track as long as the video, or hold its ends (--hold). Now."),
        ("Give this or that (argument lens).", ["calibrate"], "Give this."),
        ("Give it (argument focal).", ["calibrate"], "Give it (--focal)."),
    ],
)
def test_a_command_speaks_of_its_own_options_alone(message, words, told):
    assert with_flags(message, options_of(typer.main.get_command(app), words)) == told
