"""The command line: ``zoomjax calibrate``, ``undistort``, ``export``, ``import`` and others.

Errors go to stderr with exit status 2, and leave no partial result.
"""

import functools
import io
import os
import signal
import sys
import warnings
from typing import NoReturn

# Lines are reduced by many small factorisations, which threads of OpenBLAS only slow down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

try:
    import typer
except ModuleNotFoundError:
    sys.exit('The command line needs the extra "app": pip install "zoomjax[app]"')

from .._core.text import plain
from ..fit.compiled import UNKEPT, forget_compiled
from . import commands_interop, commands_lens, commands_reproduce  # noqa: F401, they add their commands
from ._flags import options_of, with_flags
from ._help import PlainCommand
from ._interrupts import INTERRUPTED, LAST_WORDS, end_run, leave, swallowed
from .commands import app

for _command in app.registered_commands:
    _command.cls = PlainCommand

USAGE: type[Exception] = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "UsageError")
"""What Typer raises for mistakes in the command line."""


def main() -> None:
    """Run the command line. An error that the user can fix is one message on stderr, with exit status 2."""
    warnings.showwarning = functools.partial(_print_warning, set())
    sys.unraisablehook = swallowed
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # characters that the terminal cannot show
    signal.signal(signal.SIGTERM, end_run)  # removes unfinished files
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # unless the shell ignores it
        signal.signal(signal.SIGINT, end_run)
    try:
        sys.exit(app(standalone_mode=False))
    except USAGE as error:
        _tell_usage(error)
    except (ValueError, OSError, RuntimeError, MemoryError, ImportError) as error:
        print(f"Error: {_sentence(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:  # outside of Typer
        leave(INTERRUPTED)
    except SystemExit as exit:
        if isinstance(exit.code, int) and exit.code in LAST_WORDS:
            leave(exit.code)
        raise


def _tell_usage(error: Exception) -> NoReturn:
    """A mistake in the command line, in the same style; the help where there are no arguments at all."""
    context = getattr(error, "ctx", None)
    message = getattr(error, "format_message", error.__str__)()
    if type(error).__name__ == "NoArgsIsHelpError":
        print(message)
    else:
        command = context.command_path if context else "zoomjax"
        told = plain(message).replace("Value error, ", "").rstrip(".")
        print(f"Error: {told}. See {command} --help.", file=sys.stderr)
    sys.exit(2)


def _sentence(error: BaseException) -> str:
    """The message of an error, without the error numbers of the operating system."""
    text = str(error)
    if isinstance(error, MemoryError):
        text = f"There is not enough memory. {text}".strip()
    elif isinstance(error, OSError) and error.strerror:
        text = error.strerror + (f": {os.fspath(error.filename)}" if error.filename is not None else ".")
    return plain(with_flags(text, _options()))


def _options() -> set[str] | None:
    """The options of the command that runs."""
    return options_of(typer.main.get_command(app), sys.argv[1:])


def _print_warning(told: set[str], message, *_) -> None:
    """Print a warning, unless one with this text was told: files may be looked for again."""
    unkept = UNKEPT.match(str(message))
    if unkept and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        forget_compiled(unkept[1])
        return
    if str(message) not in told:
        told.add(str(message))
        print(f"Warning: {plain(with_flags(str(message), _options()))}", file=sys.stderr)
