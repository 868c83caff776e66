"""The command line: one file per group of commands."""

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Annotated

import typer
from threadpoolctl import threadpool_limits

from hilcal import __version__
from hilcal.cli.demo import demo
from hilcal.cli.effects import effects, new
from hilcal.cli.fitting import compare, identify, validate
from hilcal.cli.next import next_
from hilcal.cli.planning import check, plan
from hilcal.cli.refining import add, diagnose, refine, remove, view
from hilcal.cli.running import run
from hilcal.cli.simulating import simulate
from hilcal.cli.study_scaling import scaling
from hilcal.cli.tables import export, import_
from hilcal.effects.added import scope
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


def _hilcal() -> typer.Typer:
    app = application(
        "Calibrate a robot arm: fit, see where the model fails, name and add what is missing."
    )
    commands: dict[str, Callable[..., None]] = {
        "demo": demo,
        "simulate": simulate,
        "check": check,
        "plan": plan,
        "run": run,
        "import": import_,
        "identify": identify,
        "compare": compare,
        "diagnose": diagnose,
        "add": add,
        "remove": remove,
        "refine": refine,
        "next": next_,
        "validate": validate,
        "view": view,
        "export": export,
    }
    for name, command in commands.items():
        app.command(name)(command)
    known = application(
        "List the effects that a model can have; new: begin one of your own.", alone=True
    )
    known.command("new")(new)
    known.callback()(effects)
    app.add_typer(known, name="effects")
    study = application("Studies of the program's own mathematics.")
    study.command("scaling")(scaling)
    study.callback()(_group)
    app.add_typer(study, name="study")
    app.callback()(_top)
    return app


def _group() -> None:
    """Studies of the program's own mathematics."""


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
    execute(_hilcal(), "hilcal", arguments)


def execute(app: typer.Typer, name: str, arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 2 wrong input, 3 a device failed, 4 cannot be answered.

    Wrong input and failures are one line on stderr; HILCAL_DEBUG=1 shows where they came from.

    Args:
        app: the commands.
        name: of the program.
        arguments: of the command line; those of the process where None.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    debug = os.environ.get(DEBUG, "") not in ("", "0")
    # The matrices are small: more threads gain nothing, and on a busy machine cost tenfold.
    threads = threadpool_limits(limits=1, user_api="blas")
    with warnings.catch_warnings(), threads, scope():
        if not debug:
            warnings.simplefilter("ignore")
        given = sys.argv[1:] if arguments is None else list(arguments)
        sys.exit(_run(app, name, given, debug))


def _run(app: typer.Typer, name: str, arguments: list[str], debug: bool) -> int:
    try:
        result = app(arguments, prog_name=name, standalone_mode=False)
        sys.stdout.flush()
    except HilcalError as error:
        return _fail(error, str(error), error.exit_code, debug)
    except BrokenPipeError:
        # Nobody reads any more; what is still in the buffer must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
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
