"""`rtcd tolerance`: largest factors against those that are known, the box's parts, and refusals in one line."""

import jax
import numpy as np
import pytest
import yaml

from rtcd_jax.analysis.tolerance.box import WHOLE, sides, stacked, with_box
from rtcd_jax.analysis.tolerance.factors import LEAST, PRECISE, largest_factors
from rtcd_jax.analysis.tolerance.study import tolerance_run
from rtcd_jax.config.load import parse, resolved
from rtcd_jax.problem import make_problem
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Status
from tests.analysis.report.runs import experiment
from tests.cli.conftest import finished  # noqa: F401 (a fixture)
from tests.consoles import Screen
from tests.test_adversary import LIMIT, scalar_funnel, uncertainty

BOX = {
    "design": {"mass": 0.02, "length": 0.01}, "plant": {"damping": 0.2}, "input_limit": 0.02, "input": 0.05,
    "noise": [0.0, 0.1], "age": 0.005,
}  # fmt: skip


def test_the_largest_factor_is_found_within_the_precision_over_seven_decades():
    truth = np.array([LEAST / 3, 0.02, 0.9, 1.0, 3.7, 50.0, 1e9, 5.0])
    most = np.array([np.inf] * 6 + [33.0, 2.0])
    found = largest_factors(lambda factors: factors <= truth, most)
    assert found[0] == 0
    assert np.all((found[1:6] <= truth[1:6]) & (truth[1:6] < PRECISE * found[1:6]))
    assert found[6:].tolist() == [33.0, 2.0]


def test_what_has_no_funnel_even_without_uncertainty_bears_nothing():
    assert largest_factors(lambda factors: factors < 0, np.array([np.inf])).tolist() == [0.0]


@pytest.mark.thorough
def test_a_disturbance_is_borne_up_to_the_known_one():
    """x' = -x + w within |x| <= LIMIT bears |w| <= LIMIT, all at once in one program."""
    box = uncertainty(residual=0.999, noise=(0.0,), input=LIMIT / 2)
    estimate = jax.jit(jax.vmap(lambda factor: scalar_funnel(0.0, box.times(factor)).status))
    (found,) = largest_factors(lambda factors: np.asarray(estimate(factors)) == Status.OK, np.array([np.inf]))
    assert found == pytest.approx(2, rel=2 * (PRECISE - 1))


def test_a_box_has_a_side_for_each_of_its_uncertainties_and_their_sum_is_the_whole():
    problem = make_problem(parse(resolved(experiment()) | {"uncertainty": BOX}))
    found = sides(problem)
    assert [(side.name, side.unit, side.width) for side in found] == [
        ("mass", "-", 0.02), ("length", "-", 0.01), ("damping", "-", 0.2), ("input limit", "-", 0.02),
        ("disturbance", "N m", 0.05), ("measured theta_dot", "rad/s", 0.1), ("age", "s", 0.005), (WHOLE, "", None),
    ]  # fmt: skip
    *singles, whole = (side.box for side in found)
    total = jax.tree.map(lambda *leaves: sum(leaves), *singles)
    for part, all_of_it in zip(jax.tree.leaves(total)[:-1], jax.tree.leaves(whole)[:-1], strict=True):
        np.testing.assert_allclose(part, all_of_it)
    assert {float(side.box.residual) for side in found} == {0.5}
    assert found[-1].most == pytest.approx(0.999 / 0.2)  # no damping above twice its own
    assert found[-2].most == pytest.approx(0.1 / 0.005)  # no measurement older than the longest interval
    boxes = stacked(found, np.arange(len(found), dtype=float))
    np.testing.assert_allclose(boxes.input, [0, 0, 0, 0, 4 * 0.05, 0, 0, 7 * 0.05])


@pytest.fixture
def box_file(tmp_path):
    path = tmp_path / "box.yaml"
    path.write_text(yaml.safe_dump({"uncertainty": BOX}))
    return path


@pytest.mark.parametrize(
    ("written", "words"),
    [
        ("uncertainty: {}", "box.yaml states no uncertainty: give --uncertainty FILE, a YAML with an `uncertainty`"),
        ("uncertainty: {design: {mas: 0.1}}", "uncertainty.design.mas: must be a design parameter of pendulum"),
        ("uncertainty: {age: -1}", "uncertainty.age = -1: must be >= 0"),
        ("input: x", "uncertainty.input = 'x': must be a number"),
        ("[1]", "uncertainty = [1]: must be a mapping"),
    ],
)
def test_a_box_that_is_wrong_is_refused(box_file, written, words):
    box_file.write_text(written)
    with pytest.raises(UserError) as error:
        with_box(experiment(), box_file)
    (line,) = str(error.value).splitlines()
    assert words in line


def test_a_run_without_uncertainty_asks_for_a_box(finished):  # noqa: F811
    with pytest.raises(UserError, match="the run states no uncertainty: give --uncertainty FILE"):
        tolerance_run(finished, 0, None, Screen().console)
