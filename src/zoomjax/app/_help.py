"""What all commands share: help without the types of flags and arguments, and no empty names of files."""

import os
from typing import Any

from typer.core import TyperCommand

from .._core.copies import is_url, shown_url

_WORDS = ("cluster", "search", "name")
"""Parameters that take words which are not of files."""

_NO_FILES = ("inputs", *_WORDS)
"""Those that take URLs, too."""


def _refuse_url(name: str, word: str, *, when: bool) -> None:
    if when and is_url(word):
        raise ValueError(
            f"{name} is {shown_url(word)!r}, but files are meant here, not URLs: "
            + ("copy the results there afterwards." if name == "--output" else "copy it first.")
        )


def _refuse_home(name: str, word: str, *, when: bool) -> None:
    at_home = word == "~" or word.startswith("~/")
    if when and at_home and (name == "--output" or not os.path.exists("~")):
        raise ValueError(
            f"{name} is {word!r}, where the shell has left ~ as it is, and not as your home folder, as in "
            "quotes and after =: write the folder in full, or ./~ for one of this name."
        )


class PlainCommand(TyperCommand):
    """A command whose help names no Python types, and whose arguments and output are not empty.

    An empty path is the working folder to `pathlib`: of a variable of the shell that is not set, all photos
    there would be used, or results written among them.
    """

    def parse_args(self, ctx: Any, args: Any) -> Any:
        """Parse the words after the command.

        Raises:
            ValueError: an argument, or the output, is empty; or there is a URL where a file is meant, or a
                home folder that the shell did not fill in, which would be one of that name here.
        """
        given: dict[str, Any] = {}
        if not ctx.resilient_parsing:  # which completes words
            given, _, _ = self.make_parser(ctx).parse_args(list(args))
        for parameter in super().get_params(ctx):
            of: Any = parameter
            path = of.name == "output" or (of.param_type_name == "argument" and of.name != "search")
            value = given.get(of.name)
            words = [
                word
                for word in (value if isinstance(value, list | tuple) else [value])
                if isinstance(word, str)
            ]
            name = max(of.opts, key=len) if of.param_type_name == "option" else "An argument"
            for word in words:
                _refuse_url(name, word, when=of.name not in _NO_FILES)
                _refuse_home(name, word, when=of.name not in _WORDS)
            if path and "" in words:
                raise ValueError(
                    f"{name} is empty, as a variable of the shell that is not set: name a file or a "
                    "folder, or . for this one."
                )
        return super().parse_args(ctx, args)

    def get_params(self, ctx: Any) -> Any:
        """The parameters, with nothing to be shown in the place of such types."""
        parameters = super().get_params(ctx)
        for parameter in parameters:
            of: Any = parameter
            if of.param_type_name == "argument":
                of.display_type_rich = lambda ctx: None
            elif getattr(of, "is_flag", False):
                of.metavar = ""
        return parameters
