"""The help of the program: its commands in the order of the work, and what the exit codes mean."""

from typing import Any

from typer.core import TyperGroup

from hilcal.cli.commands import SECTIONS

EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 the data cannot answer the question; "
    "5 a limit is not kept; 130 interrupted with Ctrl-C."
)
"""Of every command."""

EXIT_CODES_OF_RUN = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 a goal is not met; 130 interrupted "
    "with Ctrl-C. Whenever it ends early the arm is stopped, the readings so far are safe, and "
    "the line that goes on is printed."
)


class Group(TyperGroup):
    """A group whose help gives the whole summary of each command, wrapped between words."""

    sections: dict[str, tuple[str, ...]] = {}  # noqa: RUF012  (replaced, never changed)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, under headings where there are any."""
        names = self.list_commands(ctx)
        listed = {name for section in self.sections.values() for name in section}
        rest = tuple(name for name in names if name not in listed)
        widest = max(map(len, names))
        for title, section in {**self.sections, "Commands": rest}.items():
            rows = [
                (name.ljust(widest), self._summary(ctx, name)) for name in section if name in names
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def _summary(self, ctx: Any, name: str) -> str:
        command = self.get_command(ctx, name)
        return str(getattr(command, "help", None) or "").strip().split("\n\n")[0]


class InOrderOfWork(Group):
    """The group of all commands of hilcal."""

    sections = SECTIONS
