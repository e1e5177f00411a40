"""What the figures of a search draw is what generations.jsonl holds."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.text import Text

from rtcd_jax.analysis.report import tables
from rtcd_jax.analysis.report.canvas import print_chart
from rtcd_jax.analysis.report.history import courses, failures, physical, spread
from rtcd_jax.analysis.report.history import searched as searched_variables
from rtcd_jax.analysis.report.progress import charts
from rtcd_jax.analysis.report.reading import read_run
from tests.analysis.report.runs import SEARCHED_POLICY, candidate, experiment, generation, run_folder


def searched(tmp_path, generations, plant="pendulum"):
    config = experiment(plant)
    return read_run(run_folder(tmp_path / "run", config, best=candidate(config), generations=generations))


def draw(name, run):
    print_chart(charts([run])[name], run.figures, name)


def texts(figure):
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def lines(axes, label):
    return [line for line in axes.lines if line.get_label() == label]


def test_convergence_draws_the_stored_numbers_with_gaps_where_there_were_none(tmp_path, figures):
    records = [generation(k, sigma=0.3 / (k + 1)) for k in range(6)]
    records[2] |= {"best": None, "median": None, "feasible": 0.0}
    draw("convergence", searched(tmp_path, records))
    volumes, share, sigma = figures[0].axes
    for label, name in (("best", "best"), ("median", "median"), ("best so far", "best_so_far")):
        (line,) = lines(volumes, label)
        np.testing.assert_array_equal(line.get_ydata(), [np.nan if r[name] is None else r[name] for r in records])
    np.testing.assert_array_equal(sigma.lines[0].get_xydata(), [[r["index"], r["sigma"]] for r in records])
    assert {text.get_text() for text in share.get_legend().get_texts()} == {"has a funnel", "funnel empty"}
    assert volumes.get_ylabel() == "volume (sum) [rad²/s]"
    assert volumes.get_legend().get_title().get_text().startswith("sampled")


def conflicting(count=40):
    """Candidates whose volumes trade a sum for an inlet, some of them worse in both, one without a funnel."""
    share = np.linspace(0, 1, count)
    sums, inlets = 100 * (1 - share**2), 2 + 3 * share
    sums[3::7], inlets[3::7] = 0.5 * sums[3::7], 0.5 * inlets[3::7]
    volumes = {"sum": [*sums[:-1].tolist(), None], "inlet": [*inlets[:-1].tolist(), None]}
    return [generation(0, volumes=volumes)], sums[:-1], inlets[:-1]


def test_a_front_has_all_candidates_that_no_other_exceeds_in_both(tmp_path, figures):
    records, sums, inlets = conflicting()
    draw("conflicts", searched(tmp_path, records))
    drawn = figures[0].axes[0].lines[0].get_xydata()
    larger = lambda a, b: (sums >= a) & (inlets >= b) & (sums + inlets > a + b)  # noqa: E731
    by_hand = [pair for pair in zip(sums, inlets, strict=True) if not np.any(larger(*pair))]
    assert len(by_hand) == len(sums) - len(sums[3::7])
    np.testing.assert_allclose(sorted(map(tuple, drawn)), sorted(by_hand))


def test_the_table_says_what_a_share_of_the_searched_volume_buys(tmp_path):
    records, sums, inlets = conflicting()
    table = tables.conflicts(searched(tmp_path, records))
    assert table.heads == ("of sum given away [%]", "largest initial ellipsoid [rad²/s]")
    for percent, inlet in table.rows:
        assert inlet == max(inlets[sums >= (1 - percent / 100) * sums.max()])
    assert table.rows[0][1] == 2
    assert table.rows[1][1] == pytest.approx(2 + 3 * 2 / 39)


def test_nothing_conflicts_where_one_volume_was_stored(tmp_path):
    run = searched(tmp_path, [generation(0), generation(1)])
    assert "conflicts" not in charts([run])
    assert tables.conflicts(run) is None


def test_restarts_are_marked_at_their_generations_alone(tmp_path, figures):
    records = [generation(k, restarts=restarts) for k, restarts in enumerate([0, 0, 1, 1, 3])]
    draw("convergence", searched(tmp_path, records))
    for axes in figures[0].axes:
        *_, marks = [drawn for drawn in axes.collections if isinstance(drawn, LineCollection)]
        assert [segment[0, 0] for segment in marks.get_segments()] == [2, 4]
    assert "restart" in texts(figures[0])


def test_without_restarts_the_legend_has_none(tmp_path, figures):
    draw("convergence", searched(tmp_path, [generation(0), generation(1)]))
    assert "restart" not in texts(figures[0])


@pytest.mark.parametrize(("lowest", "scale"), [(11.0, "linear"), (9.0, "log")])
def test_an_axis_of_more_than_a_decade_is_logarithmic(tmp_path, figures, lowest, scale):
    records = [generation(0, median=lowest), generation(1, best=100.0, best_so_far=100.0)]
    draw("convergence", searched(tmp_path, records))
    assert figures[0].axes[0].get_yscale() == scale


def test_a_search_without_any_volume_can_be_drawn(tmp_path, figures):
    nothing = {"best": None, "median": None, "best_so_far": None, "feasible": 0.0}
    draw("convergence", searched(tmp_path, [generation(0, **nothing)]))
    assert np.isnan(figures[0].axes[0].lines[0].get_ydata()).all()


def test_a_variable_is_drawn_in_its_own_unit_between_the_ends_of_its_box(tmp_path, figures):
    run = searched(tmp_path, [generation(k) for k in range(4)])
    draw("courses", run)
    told = [axes.get_title() for axes in figures[0].axes]
    assert told == [
        "mass [kg]", "length [m]", "q1 of θ [1/(s rad²)]", "q2 of dθ/dt [1/(s (rad/s)²)]",
        "r1 of torque [1/(s (N m)²)]",
    ]  # fmt: skip
    mass, *_, weight = figures[0].axes
    assert (mass.get_yscale(), weight.get_yscale()) == ("linear", "log")
    (best,) = lines(mass, "best of the generation")
    # The third candidate has the largest volume: its genome is k / 10 + 0.2, and the mass' box [0.6, 0.8].
    np.testing.assert_allclose(best.get_ydata(), 0.6 + 0.2 * (np.arange(4) / 10 + 0.2))
    low, high = mass.get_ylim()
    assert 0.58 < low < 0.6 < 0.8 < high < 0.82


def test_decoded_values_are_those_of_the_search():
    import jax.numpy as jnp

    from rtcd_jax.genome import decode
    from rtcd_jax.problem import make_problem

    for config in (experiment("pendulum"), experiment("cartpole", policy=SEARCHED_POLICY)):
        variables = searched_variables(config)
        genome = np.linspace(0.1, 0.9, len(variables))
        candidate = decode(make_problem(config), jnp.asarray(genome))
        design = [getattr(candidate.design, name) for name in config.plant.design]
        policy = [candidate.policy[name] for name in config.policy.variables()]
        values = dict(zip(config.variables(), [*design, *candidate.q, *candidate.r, *policy], strict=True))
        for share, (name, (variable, _)) in zip(genome, variables.items(), strict=True):
            np.testing.assert_allclose(physical(variable, config.logarithmic(name), share), float(values[name]))


def test_the_spread_is_that_of_the_candidates_with_a_funnel(tmp_path):
    records = [generation(0), generation(1, volumes={"sum": [None] * 4})]
    low, high = spread(records)
    np.testing.assert_allclose([low[0], high[0]], np.percentile([40, 60, 100], (10, 90)))
    assert np.isnan([low[1], high[1]]).all()


def test_failures_are_shares_of_every_generation():
    found = failures([generation(0), generation(1, counts={"OK": 1, "NOT_FINITE": 3})])
    assert next(iter(found)) == "OK"
    np.testing.assert_allclose(found["OK"], [0.75, 0.25])
    np.testing.assert_allclose(found["FUNNEL_EMPTY"], [0.25, 0])
    np.testing.assert_allclose(found["NOT_FINITE"], [0, 0.75])


def test_a_generation_without_any_funnel_has_no_best():
    nothing = generation(1, volumes={"sum": [None] * 4})
    (mass, *_) = courses(experiment(), [generation(0), nothing])
    assert np.isfinite(mass.best[0])
    assert np.isnan(mass.best[1])
    assert np.isfinite(mass.median).all()
