"""One comparison of every robot, for all tests of the disturbances."""

import pytest

from rtcd_jax.export import rate
from tests.analysis.disturb.comparisons import comparison
from tests.export.folders import ELITES


@pytest.fixture(scope="session", autouse=True)
def _few_states():
    """Control rates are found by a tenth of the states: no test here depends on their number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rate, "STATES", 400)
        yield


@pytest.fixture(scope="session", params=list(ELITES))
def robots(request, tmp_path_factory):
    """Two loops of one robot."""
    return comparison(tmp_path_factory.mktemp("comparison") / "run", request.param)


@pytest.fixture(scope="session")
def pendulums(tmp_path_factory):
    """Two loops of the pendulum."""
    return comparison(tmp_path_factory.mktemp("comparison") / "run", "pendulum")
