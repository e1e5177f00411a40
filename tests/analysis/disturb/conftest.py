"""One contest of every robot, for all tests of the disturbances."""

import pytest

from tests.analysis.disturb.comparisons import contest
from tests.export.folders import ELITES


@pytest.fixture(scope="session", params=list(ELITES))
def robots(request, tmp_path_factory):
    """Two loops of one robot."""
    return contest(tmp_path_factory.mktemp("contest") / "run", request.param)


@pytest.fixture(scope="session")
def pendulums(tmp_path_factory):
    """Two loops of the pendulum."""
    return contest(tmp_path_factory.mktemp("contest") / "run", "pendulum")
