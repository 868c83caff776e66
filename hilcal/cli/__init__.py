"""The command line: one file per group of commands, imported when a command of it is called."""

import errno
import json
import os
import re
import shlex
import shutil
import stat
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from typing import Annotated, Any, TextIO

import typer

from hilcal import __version__, errors
from hilcal.cli import commands
from hilcal.names import escaped
from hilcal.optional import missing_package
from hilcal.store.stored_texts import recording_command

DEBUG = "HILCAL_DEBUG"
_COMPLETE = "_HILCAL_COMPLETE"
_INTERRUPTED = errors.StoppedError.exit_code
_USAGE = 2
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_CLOSED = (errno.EROFS, errno.EACCES, errno.EPERM)
_LIBRARY = re.compile(r"(\S+): cannot open shared object file")
_COMMAND = re.compile(r"(.*:) (hilcal [^,;()]*)$")
_KINDS = {
    errors.InputError.exit_code: "input",
    errors.DeviceError.exit_code: "device",
    errors.CannotAnswerError.exit_code: "cannot_answer",
    errors.LimitError.exit_code: "limit",
    errors.StoppedError.exit_code: "interrupted",
}


def one_line(message: object) -> str:
    """Return a message as it is printed: on one line, without control characters."""
    return escaped(" ".join(str(message).split()))


def error_document(message: object, code: int) -> dict[str, object]:
    """Return the "error" part of a command's JSON document."""
    kind = _KINDS.get(code, "unexpected")
    return {"error": {"message": one_line(message), "kind": kind, "exit_code": code}}


class WatchedStream:
    """A stream that records whether anything was written to it, and tolerates a closed reader.

    If its reader ends, such as `head` or a closed terminal, the command goes on, since it may write
    files or move an arm.
    """

    def __init__(self, stream: TextIO) -> None:
        """Wrap a stream; all attributes but `write` and `flush` are those of the stream."""
        self.written = False
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text; an empty one does not count."""
        self.written = self.written or bool(text)
        with self._without_reader():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        with self._without_reader():
            self._stream.flush()

    @contextmanager
    def _without_reader(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            number = self._stream.fileno()
            closed_terminal = error.errno == errno.EIO and stat.S_ISCHR(os.fstat(number).st_mode)
            if not (isinstance(error, BrokenPipeError) or closed_terminal):
                raise
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the stream."""
        return getattr(self._stream, name)


@dataclass(frozen=True, slots=True)
class Failures:
    """Reports why a command failed, in a line and with --json as a document."""

    as_json: bool
    out: WatchedStream  # where the document goes
    debug: bool  # whether tracebacks are shown

    def report(self, error: BaseException | None, message: str, code: int) -> int:
        """Print the failure as one line, with --json as a document, too; return the exit code."""
        if self.debug and error is not None:
            traceback.print_exception(error)
        print(_laid_out(f"error: {one_line(message)}"), file=sys.stderr)
        if self.as_json and not self.out.written:
            self.out.write(json.dumps(error_document(message, code), indent=2) + "\n")
            self.out.flush()
        return code


def _laid_out(line: str) -> str:
    """Return a line as a terminal shows it: wrapped, a command at its end on a separate line."""
    if not sys.stderr.isatty():
        return line
    match = _COMMAND.match(line)
    message, command = match.groups() if match else (line, "")
    width = shutil.get_terminal_size().columns
    wrap = textwrap.TextWrapper(
        width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join((*wrap.wrap(message), *([f"  {command}"] if command else ())))


def application(
    help_text: str,
    *,
    alone: bool = False,
    group: type[commands.CommandGroup] = commands.CommandGroup,
    completion: bool = False,
) -> typer.Typer:
    """Return an empty application; with `alone` it can be called without a command."""
    return typer.Typer(
        cls=group,
        add_completion=completion,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog=commands.EXIT_CODES,
        pretty_exceptions_enable=False,
        no_args_is_help=not alone,
        invoke_without_command=alone,
        rich_markup_mode=None,
        help=help_text,
    )


def _hilcal(arguments: Sequence[str]) -> typer.Typer:
    """Return the application; only the command that the arguments name is imported."""
    app = application(str(_top.__doc__), group=commands.InOrderOfWork, completion=True)
    names = [word for word in arguments if not word.startswith("-")]
    for name, command in commands.COMMANDS.items():
        if names[:1] != [name]:
            app.command(name, help=command.summary)(_placeholder)
        elif command.subcommands:
            with _loading(name):
                group = _group(command)
            app.add_typer(group, name=name)
        else:
            epilog = commands.EXIT_CODES_OF_RUN if name == "run" else commands.EXIT_CODES
            with _loading(name):
                function = commands.load(command.place)
            app.command(name, epilog=epilog)(function)
    app.callback()(_top)
    return app


@contextmanager
def _loading(name: str) -> Iterator[None]:
    """Animate a line on a terminal while the libraries of a command are loaded."""
    if not sys.stderr.isatty() or os.environ.get(_COMPLETE):
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(f"hilcal {name}"):
        yield


def _group(command: commands.Command) -> typer.Typer:
    app = application(command.summary, alone=bool(command.place))
    for name, place in command.subcommands:
        app.command(name)(commands.load(place))
    function = commands.load(command.place) if command.place else _placeholder
    app.callback(help=command.summary)(function)
    return app


def _placeholder() -> None:
    """Do nothing; placeholder of a command that is listed but not called."""


def _version(requested: bool) -> None:
    if requested:
        print(f"hilcal {__version__}")
        raise typer.Exit


def _top(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate a robot arm: fit, see where the model fails, name and add what is missing."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command of `hilcal` and exit; see `execute`."""
    argv = sys.argv[1:] if arguments is None else list(arguments)
    named = _words_to_complete() if os.environ.get(_COMPLETE) else argv
    execute(lambda: _hilcal(named), "hilcal", argv)


def _words_to_complete() -> list[str]:
    """Return the words of the line to complete, without the program's name."""
    line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")
    try:
        return shlex.split(line)[1:]
    except ValueError:  # a quote that is still open
        return line.split()[1:]


def _open_closed_streams() -> None:
    """Redirect closed standard streams, as by `>&-`, to the null device.

    Otherwise the next opened campaign would get their numbers, and the output of child processes.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest one that is free
        os.set_inheritable(number, True)
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def execute(make: Callable[[], typer.Typer], name: str, arguments: Sequence[str]) -> None:
    """Run a command and exit; see `EXIT_CODES`.

    Wrong input and failures are one line on stderr; HILCAL_DEBUG=1 shows tracebacks.
    With --json the error is a JSON document on stdout, too, unless the command has printed one.
    Errors that `make` raises are reported in the same way.
    """
    _open_closed_streams()
    for stream in (sys.stdin, sys.stdout, sys.stderr):  # a key may type half a character, too
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    debug = os.environ.get(DEBUG, "") not in ("", "0")
    argv = list(arguments)
    out = WatchedStream(sys.stdout)
    shown = WatchedStream(sys.stderr)
    with warnings.catch_warnings(), redirect_stdout(out), redirect_stderr(shown):
        if not debug:
            warnings.simplefilter("ignore")
        failed = Failures("--json" in argv, out, debug)
        sys.exit(_run(make, name, argv, failed))


@contextmanager
def _computing() -> Iterator[None]:
    """Limit BLAS to one thread: several gain nothing on small matrices and load the machine."""
    if "numpy" not in sys.modules:  # --help, --version: nothing is computed
        yield
        return
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


def _run(
    make: Callable[[], typer.Typer], name: str, arguments: list[str], failures: Failures
) -> int:
    out = failures.out
    try:
        app = make()
        with _computing(), recording_command((name, *arguments)):
            result = app(arguments, prog_name=name, standalone_mode=False)
        out.flush()
    except errors.HilcalError as error:
        return failures.report(error, str(error), error.exit_code)
    except KeyboardInterrupt:
        return failures.report(None, "interrupted", _INTERRUPTED)
    except Exception as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error, file=sys.stderr)
            return _USAGE
        return failures.report(error, *_explained(error, name))
    except SystemExit as error:
        effects = sys.modules.get("hilcal.effects.protocol")  # without it no effect has run
        failed = None if effects is None else effects.failure_of(error)
        if failed is None:
            raise
        return failures.report(error, str(failed), failed.exit_code)
    if result == _INTERRUPTED:
        return failures.report(None, "interrupted", _INTERRUPTED)
    return result if isinstance(result, int) else 0


def _explained(error: Exception, name: str) -> tuple[str, int]:
    """Return message and exit code of an error that is no `HilcalError`."""
    # The class of usage errors depends on the version of the command-line library.
    if (format_message := getattr(error, "format_message", None)) is not None:
        where = getattr(getattr(error, "ctx", None), "command_path", name)
        usage = str(format_message()).rstrip(".")
        return usage + (f" See {where} -h" if usage.endswith("?") else f"; see {where} -h"), _USAGE
    if type(error).__name__ == "Abort":
        return "interrupted", _INTERRUPTED
    if isinstance(error, OSError) and error.errno in _FULL:  # output, or a library's cache
        file = error.filename or "a file"
        hint = "make room on the disks of output, program and temporary files"
        message = f"{file} cannot be written ({os.strerror(error.errno)}): {hint}"
        return message, errors.DeviceError.exit_code
    if isinstance(error, OSError) and error.errno in _CLOSED and error.filename:
        return f"{error.filename}: no access ({os.strerror(error.errno)})", _USAGE
    if isinstance(error, FileNotFoundError) and error.filename is None:  # of os.getcwd
        return "the working directory has been deleted: change to another one", _USAGE
    if isinstance(error, ImportError) and (library := _LIBRARY.match(str(error))):
        package = " (libgomp1 on Debian)" if library[1] == "libgomp.so.1" else ""
        return f"the system library {library[1]} is missing: install its package{package}", _USAGE
    if message := missing_package(error):
        return message, _USAGE
    from hilcal.effects.protocol import failure_of

    if failed := failure_of(error):
        return str(failed), failed.exit_code
    text = " ".join(str(error).split())
    message = f"unexpected {type(error).__name__}: {text}; please report it ({DEBUG}=1 shows more)"
    return message, 1
