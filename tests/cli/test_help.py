"""The help of every command, the completion of a shell, and errors as JSON."""

import ast
import re

import pytest
import typer

from hilcal.cli import looking_up
from hilcal.cli.commands import COMMANDS, SECTIONS, load
from tests.support.cli_cases import ok, refused, run
from tests.support.paths import ROOT

Capsys = pytest.CaptureFixture[str]
ALL = [
    (),
    *((name,) for name in COMMANDS),
    *((name, sub) for name, command in COMMANDS.items() for sub, _ in command.subcommands),
]


def words(text):
    """What is said, wherever its lines are broken; the line of usage has its own layout."""
    return text.partition("\n\n")[2].split()


@pytest.mark.parametrize("command", ALL, ids=" ".join)
def test_help_breaks_and_cuts_no_word_at_any_width(
    command: tuple[str, ...], capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = {}
    for width in (60, 80, 120):
        monkeypatch.setenv("COLUMNS", str(width))
        text = ok(capsys, *command, "-h").out
        assert max(map(len, text.splitlines())) <= width
        told[width] = words(text)
    assert told[60] == told[80] == told[120]
    assert not [word for word in told[80] if word.endswith("...")]
    assert "130 interrupted with Ctrl-C" in " ".join(told[80]) or len(command) == 2


def test_the_list_of_commands_is_in_the_order_of_the_work(capsys):
    listed = [name for section in SECTIONS.values() for name in section]
    assert sorted(set(listed)) == sorted(listed)  # none twice
    assert set(COMMANDS) <= set(listed)  # none without a heading
    text = ok(capsys, "--help").out
    at = [text.index(f"\n{title}:\n") for title in SECTIONS]
    assert at == sorted(at)
    shown = [line.split()[0] for line in text[at[0] :].splitlines() if line[2:3].isalpha()]
    assert [name for name in shown if name in COMMANDS] == [n for n in listed if n in COMMANDS]
    told = " ".join(text.split())
    assert all(command.summary in told for command in COMMANDS.values())


def test_a_shell_completes_commands_and_options(capsys, monkeypatch):
    def completed(line, word):
        """What bash is offered for a word of a line."""
        monkeypatch.setenv("_HILCAL_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(word))
        return ok(capsys).out.split()

    assert completed("hilcal di", 1) == ["diagnose", "discover"]
    assert {"demo", "run", "refine"} <= set(completed("hilcal ", 1))
    assert completed("hilcal run --re", 2) == ["--resume", "--rehearse"]
    assert completed("hilcal effects ", 2) == ["new"]
    assert completed("hilcal run ce", 2) == []  # a file: the shell's own business
    assert completed("hilcal run 'ce", 2) == []  # a quote that is still open


def test_a_shell_is_told_how_to_complete(capsys, monkeypatch):
    # Which shell runs the tests is no matter; without this typer looks for it.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    script = ok(capsys, "--show-completion", "bash").out
    assert "complete -o default -F _hilcal_completion hilcal" in script


@pytest.mark.parametrize(("arguments", "kind", "code"), [
    (("diagnose", "none.hilcal"), "input", 2),
    (("plan",), "input", 2),
    (("plan", "CELL", "--no-such-option"), "input", 2)])  # fmt: skip
def test_an_error_is_one_document_with_json(arguments, kind, code, capsys):
    result = run(capsys, *arguments, "--json")
    line = refused(capsys, code, *arguments)  # without it: the same line, and nothing on stdout
    assert result.code == code
    message = line.removeprefix("error: ")
    assert result.document == {"error": {"message": message, "kind": kind, "exit_code": code}}
    assert result.err.splitlines()[-1] == line


def test_an_unexpected_error_and_an_interrupt_are_documents(capsys, monkeypatch):

    def fails(error):
        def raises(*_):
            raise error

        return raises

    monkeypatch.delenv("HILCAL_DEBUG", raising=False)
    monkeypatch.setattr(looking_up, "example_cell", fails(ZeroDivisionError("by\nzero")))
    found = run(capsys, "effects", "--json")
    assert (found.code, found.document["error"]["kind"]) == (1, "unexpected")
    assert "ZeroDivisionError: by zero" in found.document["error"]["message"]
    monkeypatch.setattr(looking_up, "example_cell", fails(KeyboardInterrupt()))
    found = run(capsys, "effects", "--json")
    assert found.code == 130
    assert found.document["error"] == {
        "message": "interrupted",
        "kind": "interrupted",
        "exit_code": 130,
    }


def test_a_usage_error_names_the_help(capsys):
    assert refused(capsys, 2, "run", "x", "--foo").endswith("see hilcal run -h")
    assert refused(capsys, 2, "diagnos").endswith("Did you mean 'diagnose'? See hilcal -h")


SAID = re.compile(r"hilcal ([a-z]+)((?: (?!and |or |first|again|to )[^\s\"'`;,)(]+)*)")


def test_every_step_that_a_message_names_can_be_taken():
    """Each command that the program's words name is one, and has the options that they give it."""
    wrong, seen = [], set()
    for path in sorted((*ROOT.glob("hilcal/**/*.py"), *ROOT.glob("drivers/**/*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.JoinedStr | ast.Constant):
                continue
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            words = "".join(
                p.value if isinstance(p, ast.Constant) and isinstance(p.value, str) else "X"
                for p in parts
            )
            for name, rest in SAID.findall(words):
                if name not in COMMANDS:
                    continue
                seen.add(name)
                places = [COMMANDS[name].place, *(p for _, p in COMMANDS[name].subcommands)]
                known = set()
                for place in filter(None, places):
                    made = typer.Typer()
                    made.command()(load(place))
                    known |= {o for p in typer.main.get_command(made).params for o in p.opts}
                wrong += [
                    f"{path.relative_to(ROOT)}:{node.lineno}: hilcal {name} {option}"
                    for option in re.findall(r"(?<= )--?[a-z][a-z-]*", rest)
                    if option not in known
                ]
    assert {"identify", "refine", "accept", "next", "plan", "run"} <= seen
    assert not wrong
