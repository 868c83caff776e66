"""Options of commands that compute on several workers.

`Workers` and `Jobs` are one per processor where neither they nor a scheduler are given; `OneWorker`
and `OneJob` are for what is computed in this process then, see `one_by_default`.
"""

from typing import Annotated

import typer

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", help="Processes of this machine; one per processor by default."
    ),
]
OneWorker = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", help="Processes of this machine; 1 by default."),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", help="Processes; one per processor by default.")
]
OneJob = Annotated[int | None, typer.Option("--jobs", help="Processes; 1 by default.")]


def _open_to_others(context: typer.Context, address: str | None) -> str | None:
    """Say what an address without TLS means."""
    if address and not address.startswith(("tls://", "wss://")) and not context.resilient_parsing:
        words = f"--scheduler {address}: without TLS, whoever reaches it runs code there and here"
        typer.echo(f"{words}, as you; tls://host:8786 keeps others out", err=True)
    return address


Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        callback=_open_to_others,
        help="Compute on a Dask cluster instead, as tls://host:8786, or tcp:// without protection.",
    ),
]


def one_by_default(workers: int | None, scheduler: str | None) -> tuple[int | None, str | None]:
    """Return what `open_engine` takes: this process where neither of both was given."""
    return (1 if workers is None and scheduler is None else workers), scheduler
