"""Options of commands that compute on several workers."""

from typing import Annotated

import typer

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", help="Processes of this machine; one per processor by default."
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", help="Processes; one per processor by default.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Compute on a Dask cluster instead, as tcp://host:8786.",
    ),
]
