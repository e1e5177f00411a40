"""The page in a real browser: no error, no request, all figures, sorting, no sideways scroll on a phone."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from rtcd_jax.analysis.report import refresh, report, tables
from rtcd_jax.analysis.report.page import render
from rtcd_jax.analysis.report.progress import SIGMA, charts
from rtcd_jax.analysis.report.reading import compared, read_run
from rtcd_jax.analysis.report.traces import plot
from rtcd_jax.system.errors import UserError
from tests.analysis.report import browser
from tests.analysis.report.runs import (
    candidate,
    experiment,
    finished,
    generation,
    proved,
    run_folder,
    verify_and_disturb,
)
from tests.paths import ROOT


def written(tmp_path_factory, plants):
    """Pages by robot, and one that compares two runs."""
    folder = tmp_path_factory.mktemp("pages")
    pages = {}
    for plant in plants:
        config = experiment(plant)
        elites = [candidate(config, seed, scale) for seed, scale in ((1, 3.0), (2, 2.0), (3, 10.0))]
        run = verify_and_disturb(run_folder(folder / plant, config, candidate(config), elites))
        pages[plant] = folder / f"{plant}.html"
        pages[plant].write_text(render([proved(run)]))
    runs = compared([read_run(finished(folder / name, scale=scale)) for name, scale in (("rtc", 2.0), ("rtcd", 5.0))])
    pages["both"] = folder / "both.html"
    pages["both"].write_text(render(runs))
    return pages


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    return written(tmp_path_factory, ("pendulum", "cartpole"))


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    if browser.program() is None:
        pytest.skip(f"no browser here: none of {', '.join(browser.NAMES)} is on the PATH (apt-get install chromium)")
    with browser.Browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


FIGURES = {"pendulum": 3 + 3 + 5, "cartpole": 4 + 5 + 5, "both": 3 + 3}
"""A plane for each coordinate, levels and convergence; the motion and each gain; where a run stands alone, a course for
each free variable."""
CHOSEN = {"pendulum": 0, "cartpole": 4, "both": 0}
"""Other planes, of which the page shows one at a time."""


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("size", [browser.LAPTOP, browser.PHONE], ids=["laptop", "phone"])
def test_a_browser_shows_every_figure_without_error_or_request_or_sideways_scroll(pages, chromium, name, size):
    tab = chromium.open(pages[name], size, touch=size == browser.PHONE)
    assert tab.complaints() == []
    assert tab.requests() == []
    drawn = tab.value(
        "[...document.querySelectorAll('.plot[data-figure]')].map((box) => box.querySelectorAll('.main-svg').length)"
    )
    assert len(drawn) == FIGURES[name] + bool(CHOSEN[name])
    assert all(drawn)
    assert tab.value("document.querySelectorAll('.scatterlayer .trace path').length") > 20
    width = "[document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    assert len(set(tab.value(width))) == 1


def test_a_page_that_asks_for_something_or_complains_would_be_seen(tmp_path, chromium):
    path = tmp_path / "bad.html"
    path.write_text(
        "<!doctype html><img src='http://127.0.0.1:9/x.png'><script>console.error('no'); missing();</script>"
    )
    tab = chromium.open(path, browser.LAPTOP)
    assert tab.requests() == ["http://127.0.0.1:9/x.png"]
    assert len(tab.complaints()) >= 2


SUMS = """(() => {
  const table = [...document.querySelectorAll("section")].find((s) => s.querySelector("h2").textContent === "Elites");
  const heads = [...table.querySelectorAll("th")];
  const column = heads.findIndex((head) => head.textContent.startsWith("sum ["));
  const read = () => [...table.querySelectorAll("tbody tr")].map((row) => row.cells[column].textContent);
  const before = read();
  const sorted = [1, 2].map(() => { heads[column].querySelector("button").click(); return read(); });
  return [before, ...sorted, heads[column].getAttribute("aria-sort")];
})()"""


def test_a_click_on_a_heading_sorts_the_elites_by_number_and_a_second_one_turns_them_round(pages, chromium):
    tab = chromium.open(pages["pendulum"], browser.LAPTOP)
    stored, rising, falling, told = tab.value(SUMS)
    assert stored == ["333", "222", "1110"]
    assert rising == ["222", "333", "1110"]
    assert falling == ["1110", "333", "222"]
    assert told == "descending"
    assert tab.complaints() == []


def test_the_slider_draws_each_funnel_s_ellipse_of_its_time(pages, chromium):
    tab = chromium.open(pages["pendulum"], browser.LAPTOP)
    moved = """(() => {
      const slider = document.querySelector(".moment input");
      slider.value = 1;
      slider.dispatchEvent(new Event("input"));
      const box = document.querySelector(".plot");
      const moments = figures[box.dataset.figure].moments;
      return moments.map(({ source, trace, points, times }) =>
        [box.data[trace].x, box.data[source].x.slice((times.length - 1) * points, times.length * points)]);
    })()"""
    for shown, last in tab.value(moved):
        assert shown == last
    assert (
        tab.value("document.querySelector('.moment output').textContent") == "3.00 s"
    )  # the goal is held for 1 s and an interval's rest


ROBOTS = """((time) => {
  show(time);
  const paths = (group) => [...group.querySelectorAll("path")].map((path) => path.getAttribute("d"));
  return svgs.map(([, svg]) => [...svg.querySelectorAll("g")].map(paths));
})(%s)"""


def test_the_robots_stand_where_the_motions_are(pages, chromium):
    """The bob, the ball that is farthest from the axis, is at l (sin theta, -cos theta) with that time's theta."""
    tab = chromium.open(pages["pendulum"], browser.LAPTOP)
    robot = tab.value("scene.robots")[1]
    bob = next(part for part in robot["parts"] if part["body"] and len(part["points"]) == 1)
    length = np.linalg.norm(bob["points"][0])
    for k in (0, 3, 9):
        groups = tab.value(ROBOTS % robot["times"][k])[1]
        for name, paths in zip(("disturbed", "nominal"), groups, strict=True):
            points = [[float(number) for number in re.findall(r"-?[0-9.]+", path)] for path in paths]
            x, down = max((each for each in points if len(each) == 2), key=np.linalg.norm)
            theta = robot[name]["x"][k][0]
            assert (x, down) == pytest.approx((length * np.sin(theta), length * np.cos(theta)), abs=2e-3)


def test_a_robot_is_turned_by_dragging_and_the_page_plays(pages, chromium):
    tab = chromium.open(pages["pendulum"], browser.LAPTOP)
    before = tab.value("svgs[0][1].innerHTML")
    drag = """(() => {
      const [, svg] = svgs[0];
      svg.setPointerCapture = () => {};
      for (const [kind, x] of [["down", 0], ["move", 90], ["up", 90]])
        svg.dispatchEvent(new PointerEvent(`pointer${kind}`, { clientX: x, clientY: 0, pointerId: 1 }));
      return svg.innerHTML;
    })()"""
    assert tab.value(drag) != before
    assert tab.value("Math.abs(view.flat().reduce((sum, value) => sum + value * value, 0) - 3)") < 1e-3  # still a turn
    tab.value("document.querySelector('.play').click()")
    assert tab.value("document.querySelector('.play').getAttribute('aria-label')") == "pause"
    tab.value("new Promise((done) => { const wait = () => now > 0.2 ? done() : setTimeout(wait, 50); wait(); })")
    tab.value("document.querySelector('.play').click()")
    assert tab.value("Math.abs(slider.value * latest - now)") < 0.02
    assert tab.complaints() == []


def test_any_two_states_can_be_chosen(pages, chromium):
    tab = chromium.open(pages["cartpole"], browser.LAPTOP)
    assert tab.value("[...document.querySelectorAll('.pair option')].length") == 6
    chosen = """(() => {
      const select = document.querySelector(".pair select");
      select.value = "plane5";
      select.dispatchEvent(new Event("change"));
      const box = document.querySelector("[data-chosen]");
      return [box.layout.xaxis.title.text, box.layout.yaxis.title.text, tube.dataset.tube, figures.plane5.pair];
    })()"""
    assert tab.value(chosen) == ["cart_dot [m/s]", "dθ/dt [rad/s]", "plane5", [2, 3]]
    assert tab.complaints() == []


def test_a_funnel_over_time_is_the_outlines_one_behind_the_other(pages, chromium):
    tab = chromium.open(pages["pendulum"], browser.LAPTOP)
    tab.value("tube.scrollIntoView()")
    tab.value("new Promise((done) => { const wait = () => tubeDrawn ? done() : setTimeout(wait, 50); wait(); })")
    assert tab.value("webgl")
    surface, source = tab.value("[tube.data[0], figures.plane0.data[0]]")
    knots = len(surface["y"])
    rows = np.array([np.nan if each is None else each for each in source["x"]], float).reshape(knots, -1)[:, :-1]
    np.testing.assert_array_equal(np.array(surface["y"]), rows)
    assert [row[0] for row in surface["x"]] == tab.value("figures.plane0.moments[0].times")


NARROW = """(() => {
  const title = (section) => section.querySelector("h2").textContent;
  const section = (name) => [...document.querySelectorAll("section")].find((each) => title(each) === name);
  const cells = [...section("Initial and optimal").querySelectorAll("tbody tr:first-child td")];
  const inside = ({ left, right }) => left >= 0 && right <= innerWidth;
  return [
    cells.map((cell) => inside(cell.getBoundingClientRect())),
    cells.map((cell) => getComputedStyle(cell, "::before").content),
  ];
})()"""


def test_a_phone_shows_every_column_of_initial_and_optimal(pages, chromium):
    inside, heads = chromium.open(pages["pendulum"], browser.PHONE, touch=True).value(NARROW)
    assert all(inside)
    assert heads[:6] == [f'"{head}"' for head in ("volume", "unit", "initial", "optimal", "ratio", "time")]


OVERLAPS = """(() => {
  const over = [];
  for (const box of document.querySelectorAll(".plot")) {
    const texts = [...box.querySelectorAll('g[class^="y"][class$="tick"] text')];
    const labels = texts.map((text) => [text.getBoundingClientRect(), text]);
    labels.sort((a, b) => a[0].top - b[0].top);
    for (let i = 1; i < labels.length; i++)
      if (labels[i][0].top < labels[i - 1][0].bottom - 4)
        over.push([box.dataset.figure, labels[i - 1][1].textContent, labels[i][1].textContent]);
  }
  return over;
})()"""
"""Labels of vertical axes of which one lies on another by more than the letters' own margins [pixels]."""


@pytest.mark.parametrize("size", [browser.LAPTOP, browser.PHONE], ids=["laptop", "phone"])
def test_no_label_of_an_axis_lies_on_another(tmp_path, chromium, size):
    """Where a step size falls by little over a decade, every digit from 1 to 9 would be labelled."""
    config, elites = experiment(), (candidate(experiment()), candidate(experiment(), 1, 3.0))
    generations = [generation(k, sigma=0.6 / 1.3**k) for k in range(11)]
    path = tmp_path / "page.html"
    path.write_text(render([read_run(run_folder(tmp_path / "run", config, *elites, generations))]))
    tab = chromium.open(path, size, touch=size == browser.PHONE)
    assert tab.value("document.querySelectorAll('g[class$=tick] text').length") > 20
    assert tab.value(OVERLAPS) == []


def test_the_page_names_nothing_outside_itself_and_forbids_every_request(pages):
    for path in pages.values():
        text = re.sub(r"<script>.*?</script>", "", path.read_text(), flags=re.DOTALL)
        assert "default-src 'none'" in text
        assert "http://" not in text
        assert "https://" not in text
        assert re.findall(r'(?:src|href)="(?!data:)', text) == []


def test_what_a_page_holds_is_strict_json_and_its_names_are_escaped(tmp_path):
    run = finished(tmp_path / "<b>&")
    text = render([read_run(run)])
    assert "<b>&" not in text
    assert "&lt;b&gt;&amp;" in text
    (data,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', text, flags=re.DOTALL)
    assert set(json.loads(data)) >= {"plane0", "levels", "convergence"}
    assert "NaN" not in data


def test_the_absence_of_an_initial_funnel_is_told(tmp_path):
    config = experiment()
    initial = candidate(config, status="RICCATI_INDEFINITE")
    text = render([read_run(run_folder(tmp_path / "run", config, initial, candidate(config, 1)))])
    assert "the initial candidate has no funnel (RICCATI_INDEFINITE)." in text


def test_pictures_of_an_experiment_are_in_the_page(tmp_path, pages):
    run = verify_and_disturb(finished(tmp_path / "run"))
    (run / "disturbance" / "off_nominal_map.png").write_bytes(b"picture")
    assert '<img src="data:image/png;base64,cGljdHVyZQ=="' in render([read_run(run)])
    assert "<img" not in pages["pendulum"].read_text()


def test_the_video_of_a_run_is_in_the_page_else_its_moving_picture(tmp_path):
    run = finished(tmp_path / "run")
    assert "Swing-up" not in render([read_run(run)])
    (run / "animation").mkdir()
    (run / "animation" / "swingup.gif").write_bytes(b"picture")
    text = render([read_run(run)])
    assert "<h2>Swing-up</h2>" in text
    assert '<img src="data:image/gif;base64,cGljdHVyZQ=="' in text
    (run / "animation" / "swingup.mp4").write_bytes(b"picture")
    text = render([read_run(run)])
    assert 'src="data:video/mp4;base64,cGljdHVyZQ=="' in text
    assert "data:image/gif" not in text
    assert "media-src data:" in text


def test_shares_are_told_in_percent_and_what_fails_first_comes_first(tmp_path):
    run = finished(tmp_path / "run")
    (run / "disturbance").mkdir()
    scores = {name: {"score": 0.8, "mass": 1.0, "delay": share} for name, share in (("initial", 1.0), ("best", 0.6))}
    (run / "disturbance" / "robustness.json").write_text(json.dumps({"summary": scores}))
    (table,) = [tables.experiment(each) for each in read_run(run).experiments]
    assert table.heads == ("", "score [%]", "delay [%]", "mass [%]")
    assert table.rows == (("initial", 80.0, 100.0, 100.0), ("best", 80.0, 60.0, 100.0))
    charted = charts([read_run(run)])["convergence"]
    assert charted.panels[1].label == "candidates\nby status [%]"
    assert charted.reading in SIGMA


def test_what_a_funnel_tolerates_is_in_the_page(tmp_path):
    run = finished(tmp_path / "run")
    mass = {"name": "mass", "unit": "-", "half_width": 0.02, "factor": 1.75, "borne": 0.035, "volumes": {"sum": 7.5}}
    rows = [mass, {"name": "whole box", "unit": "", "half_width": None, "factor": 0.5, "borne": None}]
    (run / "tolerance").mkdir()
    (run / "tolerance" / "001.json").write_text(json.dumps({"rows": rows}))
    (run / "tolerance" / "001.png").write_bytes(b"picture")
    text = render([read_run(run)])
    assert "Tolerance: elite 001" in text
    assert all(f'data-value="{number!r}"' in text for number in (1.75, 0.035, 7.5))
    assert '<img src="data:image/png;base64,cGljdHVyZQ=="' in text
    (run / "tolerance" / "001.json").write_text(json.dumps({"rows": [3]}))
    with pytest.raises(UserError, match=r"cannot read .*001.json: rows\[0\] is of another kind than a run writes"):
        read_run(run)


def test_a_page_that_is_there_is_brought_up_to_date_and_none_is_made(tmp_path):
    run = finished(tmp_path / "run")
    assert refresh(run) is None
    assert not (run / "report.html").exists()
    (run / "report.html").write_text(render([read_run(run)]))
    verify_and_disturb(run)
    assert refresh(run) == run / "report.html"
    assert (run / "report.html").read_text() == render([read_run(run)])
    assert "not refuted" in (run / "report.html").read_text()
    assert not (run / "figures").exists()


def test_compared_searches_show_best_median_and_feasible_share_over_their_candidates(tmp_path):
    runs = compared([read_run(finished(tmp_path / name, scale=scale)) for name, scale in (("rtc", 2.0), ("rtcd", 5.0))])
    data = plot(charts(runs)["convergence"])["data"]
    assert [(line["name"], line["yaxis"], line["showlegend"]) for line in data if line["legendgroup"] == "rtc"] == [
        ("rtc (sum)", "y", True), ("rtc, median", "y", False), ("rtc, feasible", "y2", False),
    ]  # fmt: skip
    second = [line for line in data if line["legendgroup"] == "rtcd"]
    assert [line["y"] for line in second] == [[100.0, 101.0, 102.0], [60.0] * 3, [75.0] * 3]
    assert all(line["x"] == [4, 8, 12] for line in data)
    assert {line["line"]["color"] for line in second} == {runs[1].color}


def test_plotly_knows_every_property_of_every_plot(pages):
    from plotly.graph_objects import Figure

    for name, count in FIGURES.items():
        (data,) = re.findall(r'id="figures">(.*?)</script>', pages[name].read_text(), flags=re.DOTALL)
        drawn = json.loads(data)
        assert len(drawn) == count + CHOSEN[name]
        for each in drawn.values():
            assert len(Figure(each["data"], each["layout"]).data) == len(each["data"])


@pytest.mark.thorough
def test_one_run_gets_its_page_and_figures_several_get_one_beside_them(tmp_path, figures):
    first, second = (finished(tmp_path / name, scale=scale) for name, scale in (("rtc", 2.0), ("rtcd", 5.0)))
    page, *drawn = report([first])
    assert page == first / "report.html"
    assert {path.relative_to(first) for path in drawn} == {
        first.relative_to(first) / "figures" / f"{name}.{kind}"
        for name in ("overlay", "funnel", "tube", "levels", "motion", "gains", "courses", "convergence")
        for kind in ("png", "pdf")
    }
    before = sorted(first.rglob("*"))
    page, *drawn = report([first], tmp_path / "shared.html")
    assert {path.parent for path in drawn} == {tmp_path / "shared_figures"}
    assert sorted(first.rglob("*")) == before
    assert report([first, second])[0] == tmp_path / "comparison.html"
    assert report([first, second], tmp_path / "mine.html") == [
        tmp_path / f"mine.{kind}" for kind in ("html", "png", "pdf")
    ]


@pytest.mark.thorough
def test_a_report_asked_for_in_a_notebook_s_shell_is_drawn_into_files(tmp_path):
    """Jupyter names a backend that only its own environment has, here one that ours has not."""
    run = finished(tmp_path / "run")
    jupyter = os.environ | {"MPLBACKEND": "module://ipympl.backend_nbagg"}
    done = subprocess.run([sys.executable, "-m", "rtcd_jax", "report", run], cwd=ROOT, env=jupyter, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert (run / "figures" / "overlay.png").is_file()


@pytest.mark.thorough
def test_a_page_that_cannot_be_written_is_refused(tmp_path, figures):
    run = finished(tmp_path / "run")
    with pytest.raises(UserError, match=r"--to = .*: must be a file, and this is a folder"):
        report([run], tmp_path)
    (run / "figures").write_text("in the way")
    with pytest.raises(UserError, match=r"cannot write .*figures"):
        report([run])


@pytest.mark.thorough
def test_a_run_that_has_lost_its_generations_has_a_page_without_them(tmp_path):
    config = experiment()
    lost = run_folder(tmp_path / "lost", config, candidate(config), candidate(config, 1), generations=[])
    page = render([read_run(lost)])
    assert "whose lines are lost" in page
    assert "external funnel" not in page
    assert "<h2>Search</h2>" not in page
    whole = finished(tmp_path / "whole")
    assert "<h2>Search</h2>" in render([read_run(whole)])
    assert "<h2>Compared</h2>" in render(compared([read_run(lost), read_run(whole)]))
