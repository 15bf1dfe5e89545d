"""The help of commands: without the types of flags and arguments, which say less than their names."""

from typing import Any

from typer.core import TyperCommand


class PlainCommand(TyperCommand):
    """A command whose help names no Python types."""

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
