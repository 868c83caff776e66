"""A library of the system that is not installed is one line, as on a minimal computer."""

import pytest
import typer

from hilcal import cli
from tests.support.cli_cases import refused


def test_a_missing_system_library_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pinocchio needs the run-time library of OpenMP, which a minimal Debian lacks."""

    def load(_: str) -> typer.Typer:
        raise ImportError("libgomp.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(cli, "load", load)
    line = refused(capsys, 2, "doctor")
    assert "the system library libgomp.so.1 is missing: install its package (libgomp1" in line
