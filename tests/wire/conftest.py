"""One simulated cell for the files that let campaigns meet faults."""

import pytest

from tests.support.campaign_cases import site


@pytest.fixture(scope="module")
def cell(request, tmp_path_factory):
    """One simulated cell for a file, with a plan that is long enough for all of its runs."""
    runs = sum(
        item.path == request.path and "path" in getattr(item, "fixturenames", ())
        for item in request.session.items
    )
    readings = 3 * runs // 2 + 5 + getattr(request.module, "MORE_READINGS", 0)
    poses = -(-(readings - 4) // 3)  # with two loads, P poses are 3 P + 4 readings and some
    with site(tmp_path_factory.mktemp("cell"), poses=poses) as made:
        yield made


@pytest.fixture
def nothing_goes_on(cell):
    """End what a test that failed has left running, and let the arm move at its full speed."""
    yield
    cell.end_runs()
    cell.slider(1.0)


@pytest.fixture(scope="module")
def path(cell):
    """The campaign that the tests of a file measure, one after the other."""
    return cell.directory / "run.hilcal"
