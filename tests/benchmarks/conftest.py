"""What the benchmarks measured, against what is claimed: printed at the end of `make bench`."""

from pathlib import Path

import pytest

_CLAIMS = pytest.StashKey[list[str]]()


@pytest.fixture
def claim(request):
    """Function that notes a claim, what was measured of it, and the limit, all in words."""

    def note(what, measured, limit):
        claims = request.config.stash.setdefault(_CLAIMS, [])
        claims.append(f"{what}: {measured} ({limit})")

    return note


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter):
    """Print the claims below the tables of times."""
    claims = terminalreporter.config.stash.get(_CLAIMS, [])
    if claims:
        terminalreporter.section("claims of the benchmarks: measured (limit)")
        for line in claims:
            terminalreporter.write_line(line)


def pytest_collection_modifyitems(items):
    """Refuse what `make bench` would skip silently."""
    for item in items:
        is_benchmark = item.path.parent == Path(__file__).parent
        if is_benchmark and "benchmark" not in getattr(item, "fixturenames", ()):
            raise pytest.UsageError(f"{item.nodeid} does not use the fixture `benchmark`")
