"""A search that begins where a former one ended."""

import pytest

from rtcd_jax.config.load import resolved
from rtcd_jax.elite.warm_start import begun_from
from rtcd_jax.system.errors import UserError
from tests.analysis.report.runs import candidate, experiment, run_folder


@pytest.fixture
def former(tmp_path):
    """A pendulum's run whose best candidate is 0.65 kg, 0.45 m, Q 3, 20, R 2."""
    config = experiment("pendulum")
    chosen = {"design": {"mass": 0.65, "length": 0.45}, "weights": {"q": [3.0, 20.0], "r": [2.0]}}
    return run_folder(tmp_path / "former", config, best=candidate(config, **chosen))


def test_the_free_variables_begin_at_the_best_candidate_inside_their_boxes(former):
    config = experiment("pendulum")
    begun = begun_from(config, former)
    variables = begun.variables()
    assert variables["design.mass"].initial == 0.65
    assert variables["design.length"].initial == 0.45
    assert variables["weights.q.0"].initial == 3
    assert variables["weights.q.1"].initial == variables["weights.q.1"].max == 10
    assert variables["weights.r.0"].initial == 2
    same = resolved(begun)
    for name, variable in config.variables().items():
        section, *keys = name.split(".")
        place = same[section]
        for key in keys:
            place = place[int(key)] if isinstance(place, list) else place[key]
        place["initial"] = variable.initial
    assert same == resolved(config)


def test_another_robot_s_run_is_refused(former):
    with pytest.raises(UserError, match="is a run of the pendulum, and the configuration is of the cartpole"):
        begun_from(experiment("cartpole"), former)
