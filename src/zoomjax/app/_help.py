"""What all commands share: help without the types of flags and arguments, and no empty names of files."""

from typing import Any

from typer.core import TyperCommand

from .._core.copies import is_url, shown_url

_NO_FILES = ("inputs", "cluster", "search", "name")
"""Parameters that take URLs, or words that are not of files."""


class PlainCommand(TyperCommand):
    """A command whose help names no Python types, and whose arguments and output are not empty.

    An empty path is the working folder to `pathlib`: of a variable of the shell that is not set, all photos
    there would be used, or results written among them.
    """

    def parse_args(self, ctx: Any, args: Any) -> Any:
        """Parse the words after the command.

        Raises:
            ValueError: an argument, or the output, is empty; or there is a URL where a file is meant, which
                would be one of that name here.
        """
        given: dict[str, Any] = {}
        if not ctx.resilient_parsing:  # which completes words
            given, _, _ = self.make_parser(ctx).parse_args(list(args))
        for parameter in super().get_params(ctx):
            of: Any = parameter
            path = of.name == "output" or (of.param_type_name == "argument" and of.name != "search")
            value = given.get(of.name)
            values = value if isinstance(value, list | tuple) else [value]
            name = "--output" if of.name == "output" else "An argument"
            for url in values if of.name not in _NO_FILES else ():
                if isinstance(url, str) and is_url(url):
                    name = max(of.opts, key=len) if of.param_type_name == "option" else name
                    raise ValueError(
                        f"{name} is {shown_url(url)!r}, but files are meant here, not URLs: "
                        + (
                            "copy the results there afterwards."
                            if of.name == "output"
                            else "copy it first."
                        )
                    )
            if path and "" in values:
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
