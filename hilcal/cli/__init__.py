"""The command line: one file per group of commands, imported where it is used."""

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from typing import Annotated

import typer

from hilcal import __version__
from hilcal.cli.commands import COMMANDS, Command, load
from hilcal.errors import HilcalError

DEBUG = "HILCAL_DEBUG"
_BROKEN_PIPE = 141
_INTERRUPTED = 130
_USAGE = 2


def application(help_text: str, *, alone: bool = False) -> typer.Typer:
    """Return an empty application.

    Args:
        help_text: what it is for.
        alone: whether it does something without a command.
    """
    return typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        no_args_is_help=not alone,
        invoke_without_command=alone,
        rich_markup_mode=None,
        help=help_text,
    )


def _hilcal(arguments: Sequence[str]) -> typer.Typer:
    """Return the application; of its commands only the one that the arguments name is imported."""
    app = application(str(_top.__doc__))
    words = [word for word in arguments if not word.startswith("-")]
    for name, command in COMMANDS.items():
        if words[:1] != [name]:
            app.command(name, help=command.summary)(_placeholder)
        elif command.subcommands:
            app.add_typer(_group(command), name=name)
        else:
            app.command(name)(load(command.place))
    app.callback()(_top)
    return app


def _group(command: Command) -> typer.Typer:
    """Return a command that has commands of its own."""
    app = application(command.summary, alone=bool(command.place))
    for name, place in command.subcommands:
        app.command(name)(load(place))
    app.callback(help=command.summary)(load(command.place) if command.place else _placeholder)
    return app


def _placeholder() -> None:
    """Hold the place of a command that is listed and not used."""


def _version(asked: bool) -> None:
    if asked:
        print(f"hilcal {__version__}")
        raise typer.Exit


def _top(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Calibrate a robot arm: fit, see where the model fails, name and add what is missing."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command of `hilcal` and exit; see `execute`."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    execute(lambda: _hilcal(given), "hilcal", given)


def execute(make: Callable[[], typer.Typer], name: str, arguments: Sequence[str]) -> None:
    """Run a command and exit: 0 done, 2 wrong input, 3 a device failed, 4 cannot be answered.

    Wrong input and failures are one line on stderr; HILCAL_DEBUG=1 shows where they came from.

    Args:
        make: returns the application; what it raises is reported like what a command raises.
        name: of the program.
        arguments: of the command line.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    debug = os.environ.get(DEBUG, "") not in ("", "0")
    with warnings.catch_warnings(), redirect_stdout(sys.stdout):
        if not debug:
            warnings.simplefilter("ignore")
        sys.exit(_run(make, name, list(arguments), debug))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit BLAS to one thread: more gain nothing on small matrices, and cost on a busy machine."""
    if "numpy" not in sys.modules:  # --help, --version: nothing is computed
        yield
        return
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def _run(make: Callable[[], typer.Typer], name: str, arguments: list[str], debug: bool) -> int:
    out = sys.stdout
    try:
        app = make()
        with _one_thread():
            result = app(arguments, prog_name=name, standalone_mode=False)
        out.flush()
    except HilcalError as error:
        return _fail(error, str(error), error.exit_code, debug)
    except BrokenPipeError:
        # Nobody reads any more; what is still in the buffer must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())
        return _BROKEN_PIPE
    except KeyboardInterrupt:
        return _fail(None, "interrupted", _INTERRUPTED, debug)
    except Exception as error:
        # Usage errors are of the command-line library, which one depends on its version.
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error, file=sys.stderr)
            return _USAGE
        told = getattr(error, "format_message", None)
        if told is not None:
            return _fail(error, f"{told()}".replace("\n", " "), _USAGE, debug)
        if type(error).__name__ == "Abort":
            return _fail(error, "interrupted", _INTERRUPTED, debug)
        from hilcal.effects.failure import failure_of  # loads numpy, which takes a while

        if failed := failure_of(error):
            return _fail(error, str(failed), failed.exit_code, debug)
        words = " ".join(str(error).split())
        report = (
            f"unexpected {type(error).__name__}: {words}; please report it ({DEBUG}=1 shows more)"
        )
        return _fail(error, report, 1, debug)
    if result == _INTERRUPTED:
        print("error: interrupted", file=sys.stderr)
    return result if isinstance(result, int) else 0


def _fail(error: BaseException | None, message: str, code: int, debug: bool) -> int:
    if debug and error is not None:
        traceback.print_exception(error)
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return code
