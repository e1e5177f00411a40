"""`rtcd report`: one HTML page that needs nothing but itself, and the same figures for print.

plotly.js, the data, style and script stand in the page, whose security policy forbids every request. Tables sort by
a click on a heading.
"""

import base64
import dataclasses
import html
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from rtcd_jax.analysis.report import tables
from rtcd_jax.analysis.report.canvas import print_chart
from rtcd_jax.analysis.report.charts import Chart
from rtcd_jax.analysis.report.charts import table as csv_of
from rtcd_jax.analysis.report.elements import four_digits, note, place, section, table
from rtcd_jax.analysis.report.funnels import draw_funnels, draw_over, draw_tubes, levels
from rtcd_jax.analysis.report.motion import STARTS, charts_of_motion
from rtcd_jax.analysis.report.plots import planes_of
from rtcd_jax.analysis.report.progress import charts
from rtcd_jax.analysis.report.reading import (
    Experiment,
    FunnelView,
    Run,
    Tolerance,
    compared,
    funnel_views,
    read_run,
)
from rtcd_jax.analysis.report.robot import robots_of
from rtcd_jax.analysis.report.traces import Plot, legend, plots_of
from rtcd_jax.analysis.report.words import duration, guarantee, ratio, volume_unit, words
from rtcd_jax.elite.records import task_folders, task_of
from rtcd_jax.system.console import Console
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import replace

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; media-src data:"
)
"""What the browser may do: run and show what is in the page."""


def report(folders: Sequence[Path], to: Path | None = None, console: Console | None = None) -> list[Path]:
    """Writes the page of a finished run, or one that compares several, and its figures; the page's path first.

    Certificates that were not checked yet are checked first, and `console` shows how far that is.

    One run for several tasks: a page for each task in its folder, and the tasks compared in the run's `report.html`.
    One run: `report.html` and `figures/` in its folder. Several: `comparison.html` beside the first folder, with
    `comparison.png` and `.pdf`. `to`, say NAME.html, is another path for the page; then one run's figures are in
    NAME_figures/ beside it, and the run's folder is only read.

    Raises:
        UserError: a folder that is no finished run's, runs of different robots, or a path that cannot be written.
    """
    if to is not None and to.is_dir():
        raise UserError(f"--to = {to}: must be a file, and this is a folder")
    if len(folders) == 1 and (tasks := task_folders(folders[0])) != list(folders):
        pages = [] if to else [path for task in tasks for path in report([task], console=console)]
        return report(tasks, to or folders[0] / "report.html", console) + pages
    runs = [read_run(folder, console) for folder in folders]
    if len(runs) == 1:
        (run,), page = runs, to or folders[0] / "report.html"
        drawn = draw_figures(dataclasses.replace(run, figures=to.with_name(f"{to.stem}_figures")) if to else run)
    else:
        runs = compared(runs)
        page = to or folders[0].resolve().parent / "comparison.html"
        drawn = draw_over(runs, page.parent, page.stem)
    replace(page, render(runs).encode())
    return [page, *drawn]


def refresh(folder: Path, console: Console | None = None) -> Path | None:
    """The run's page written anew, with what was proved, verified and tried since; None where there is no page.

    The figures beside it show none of that, and stay. Raises UserError as `report`.
    """
    page, tasks = folder / "report.html", task_folders(folder)
    for task in tasks:
        if task != folder:
            refresh(task, console)
    if not page.is_file():
        return None
    runs = [read_run(task, console) for task in tasks]
    replace(page, render(runs if len(runs) == 1 else compared(runs)).encode())
    return page


def draw_figures(run: Run) -> list[Path]:
    """The figures of one run, NAME.png and .pdf in `run.figures`, and of charts NAME.csv; the figures' paths.

    Raises UserError if they cannot be written.
    """
    funnels = draw_over([run], run.figures, "overlay") + draw_funnels(run) + draw_tubes(run)
    note = guarantee(run.best.record)
    others = {"levels": levels(run.config, run.funnels, note), **charts_of_motion(run.config, run.funnels)}
    others |= charts([run])
    drawn = [path for name, chart in others.items() for path in print_chart(chart, run.figures, name)]
    for name, chart in others.items():
        replace(run.figures / f"{name}.csv", csv_of(chart).encode())
    return funnels + drawn


def render(runs: Sequence[Run]) -> str:
    """The whole page."""
    title = html.escape(" and ".join(run.name for run in runs))
    views = funnel_views(runs)
    of_motion, of_search = charts_of_motion(runs[0].config, views), charts(runs)
    planes, others = planes_of(runs[0].config, views)
    figures = planes | others | plots_of("levels", levels(runs[0].config, views))
    for name, chart in {**of_motion, **of_search}.items():
        figures |= plots_of(name, chart)
    funnels = _funnels(runs, views, planes, others)
    body = "\n".join([_header(runs), *_sections(runs, funnels, of_motion, of_search)])
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n<link rel="icon" href="data:,">\n'
        f"<style>\n{_asset('page.css')}</style>\n<script>{_plotly()}</script>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f"{_data('figures', figures)}\n{_data('robots', robots_of(views))}\n<script>\n{_asset('page.js')}</script>\n"
        "</body>\n</html>\n"
    )


def _data(name: str, content: Any) -> str:
    """What the page's script reads."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def _header(runs: Sequence[Run]) -> str:
    first = runs[0].config
    about = f"{first.plant.name}, {first.trajectory.knots} knots"
    if len(runs) == 1:
        search = first.search
        if runs[0].audited:
            about += "; an external funnel, audited"
        else:
            about += f"; {search.mode} search for the largest {words(search.objective)}, "
            about += f"{search.generations} generations of {search.population}"
            about += "" if runs[0].generations else ", whose lines are lost"
        cards = "".join(_card(*card) for card in _headlines(runs[0]))
        candidate = f'<p class="candidate">best: {html.escape(tables.candidate(runs[0]))}</p>'
    else:
        cards = "".join(
            _card(f"{run.name}: {name}", value, remark) for run in runs for name, value, remark in [_gained(run, "sum")]
        )
        candidate = ""
    if first.task.caught:
        about += f"; ends in a catch set: {first.task.catch.in_words(first.plant.states)}"
    names = " · ".join(html.escape(run.name) for run in runs)
    head = f'<h1>{names}</h1><p class="about">{html.escape(about)}</p>'
    return f'<header>{head}{candidate}<div class="cards">{cards}</div></header>'


def _headlines(run: Run) -> Iterator[tuple[str, str, str]]:
    """Name, value and remark of what is looked for first."""
    objective = run.config.search.objective
    for name in dict.fromkeys((objective, "sum", "inlet")):
        of_the_best, value, remark = _gained(run, name)
        yield of_the_best, value, f"{remark}, searched" if name == objective else remark
    yield "swing-up", duration(float(run.best.time[-1])), "of the best, start to goal"
    certificate = run.certificates.get("000")
    if certificate is None:
        yield "proof", "none yet", "rtcd certify"
    elif certificate.guarantee is None:
        yield "proof", "none", f"certificate {certificate.verdict}"
    else:
        yield "proof", certificate.guarantee, "of the best's funnel"
    verdict = tables.verdict(run)
    yield "verification", verdict or "none yet", "by independent simulators" if verdict else "rtcd verify"


def _gained(run: Run, volume: str) -> tuple[str, str, str]:
    """A volume of the best over the initial candidate's; by itself where that one has no funnel."""
    gain = ratio(run.best.volumes[volume], run.initial.volumes[volume]) if run.initial else None
    if gain is None:
        value = f"{four_digits(run.best.volumes[volume])} {volume_unit(run.config, volume)}"
        return words(volume), value, f"{run.best.guarantee}; initially none"
    return f"{words(volume)} over initial", f"× {four_digits(gain)}", run.best.guarantee


def _card(name: str, value: str, remark: str) -> str:
    parts = (("span", name), ("strong", value), ("small", remark))
    return f'<div class="card">{"".join(f"<{tag}>{html.escape(text)}</{tag}>" for tag, text in parts)}</div>'


def _sections(
    runs: Sequence[Run], funnels: Iterable[str], of_motion: Mapping[str, Chart], of_search: Mapping[str, Chart]
) -> Iterator[str]:
    alone = runs[0] if len(runs) == 1 else None
    if alone is None:
        yield section("Compared", table(tables.comparison(runs)))
    yield section("Funnels", *funnels)
    for run in runs:
        if video := _video(run.path, run.name):
            yield section("Swing-up" if alone else f"Swing-up: {run.name}", video)
    wholes = {run.path.parent.parent for run in runs if task_of(run.path)}
    for whole in wholes if alone is None else ():
        if video := _video(whole, whole.name):
            yield section("Swing after swing", video)
    for name, chart in of_motion.items():
        yield section(chart.title, *_charted(name, chart))
    promise = "" if alone is None else note(f"The best funnel is {guarantee(alone.best.record)}.")
    advice = (
        "Ratios are optimal over initial. The sum counts knots, most of them near the goal: look at the initial "
        "ellipsoid too, that of the first knot, where disturbances come first; configurations call it the inlet."
    )
    yield section("Initial and optimal", table(tables.gains(runs), folds=True), promise, note(advice))
    for name, chart in of_search.items():
        conflicts = tables.conflicts(runs[0]) if name == "conflicts" else None
        yield section(chart.title, *([table(conflicts)] if conflicts else []), *_charted(name, chart))
    if alone:
        yield section("Elites", table(tables.elites(alone)), note("Click a heading to sort."))
    yield section("Certificates", *_certified(runs))
    verification = tables.verification(runs)
    yield section("Verification", table(verification) if verification else note("Nothing yet: rtcd verify RUN."))
    for run in runs:
        for experiment in run.experiments:
            name = words(experiment.name) if alone else f"{words(experiment.name)}: {run.name}"
            yield section(f"Disturbance: {name}", table(tables.experiment(experiment)), *_pictures(experiment))
        for tolerated in run.tolerances:
            name = f"Tolerance: elite {tolerated.elite}" + ("" if alone else f" of {run.name}")
            yield section(name, table(tables.tolerance(run, tolerated)), *_pictures(tolerated))
    yield section("Provenance", table(tables.provenance(runs)))


def _charted(name: str, chart: Chart) -> Iterator[str]:
    """The places of a chart's plots, and its note."""
    if chart.columns == 1:
        yield place(name, ("", "tall", "taller")[min(len(chart.panels) // 3, 2)])
    else:
        labels = {label: color for panel in chart.panels for label, color in legend(panel).items()}
        keys = (
            f'<span><i style="background:{color}"></i>{html.escape(label)}</span>' for label, color in labels.items()
        )
        yield f'<p class="legend">{"".join(keys)}</p>'
        yield f'<div class="grid">{"".join(place(each, "small") for each in plots_of(name, chart))}</div>'
    for text in filter(None, (chart.note, chart.reading)):
        yield note(f"{text[0].upper()}{text[1:]}.")


def _funnels(
    runs: Sequence[Run], views: Sequence[FunnelView], planes: Mapping[str, Plot], others: Mapping[str, Plot]
) -> Iterator[str]:
    for run in runs:
        if run.absence:
            yield note(f"{run.name}: {run.absence}" if len(runs) > 1 else f"{run.absence}.")
    yield (
        '<div class="moment"><button type="button" class="play" aria-label="play">▶</button>'
        "<label>motion and ellipsoid at <output>0.00 s</output>"
        '<input type="range" min="0" max="1" step="0.002" value="0" aria-label="time along the motion"></label></div>'
    )
    yield f'<div class="robots">{"".join(_robot(i, view) for i, view in enumerate(views))}</div>'
    yield note(
        f"Pale: of {STARTS} motions from the boundary of the first ellipsoid the one that uses most of the funnel, in "
        "the planes a dotted line. Drag a robot to turn it."
    )
    yield f'<div class="grid wide">{"".join(map(place, planes))}</div>'
    yield note(
        "Shadows of every knot's ellipsoid on the plane of a coordinate and its velocity. A click in the legend hides."
    )
    chosen = next(iter(others or planes))
    if others:
        options = "".join(
            f'<option value="{name}"{" selected" * (name == chosen)}>{html.escape(_axes(plot))}</option>'
            for name, plot in {**planes, **others}.items()
        )
        yield f'<label class="pair">plane of <select aria-label="plane of two states">{options}</select></label>'
    flat = f'<div class="plot" data-figure="{chosen}" data-chosen></div>' if others else ""
    yield f'<div class="grid wide">{flat}<div class="plot tube" data-tube="{chosen}"></div></div>'
    yield place("levels", "tall")
    for run in runs:
        if push := run.best.record.get("push"):
            whose = f"{run.name}: " if len(runs) > 1 else ""
            yield note(whose + _push_margin(run, push))


def _axes(plot: Plot) -> str:
    """`θ [rad], dθ/dt [rad/s]`."""
    return ", ".join(plot["layout"][axis]["title"]["text"] for axis in ("xaxis", "yaxis"))


def _robot(number: int, view: FunnelView) -> str:
    """The place of a robot, its name and what is said of the disturbed motion at the slider's time."""
    name = html.escape(view.label)
    return (
        f'<figure class="robot" data-robot="{number}"><svg role="img" aria-label="robot, {name}"></svg>'
        f'<figcaption><i style="background:{view.color}"></i>{name}<output></output></figcaption></figure>'
    )


def _video(run: Path, name: str) -> str | None:
    """What `rtcd animate` left in a run's folder: the video, else the moving picture."""
    folder, label = run / "animation", f'aria-label="swing-up of {html.escape(name)}"'
    video, picture = folder / "swingup.mp4", folder / "swingup.gif"
    if video.is_file():
        return f'<video controls loop muted playsinline {label} src="data:video/mp4;base64,{_base64(video)}"></video>'
    if picture.is_file():
        return f'<img src="data:image/gif;base64,{_base64(picture)}" alt="swing-up of {html.escape(name)}">'
    return None


def _push_margin(run: Run, push: Mapping[str, float | None]) -> str:
    """The statement that the margin makes, and what the limits on the states leave of any funnel."""
    unit = volume_unit(run.config, "push")
    most, limits = push["within_limits"], ""
    if most:
        limits = f"; there the limits on the states leave no more than {most:.3g} {unit}"
    return (
        f"Push margin ({run.best.guarantee}, at the knots): a motion on its nominal stays in the funnel "
        f"after an impulse of up to {push['margin']:.3g} {unit}; the least is that at {push['time']:.3g} s{limits}."
    )


def _certified(runs: Sequence[Run]) -> Iterator[str]:
    certificates = tables.certificates(runs)
    if certificates is None:
        yield note("Nothing yet: rtcd certify RUN.")
        return
    yield table(certificates)
    for run in runs:
        ranks = tables.ranks(run)
        if ranks:
            whose = f"{run.name}: " if len(runs) > 1 else ""
            correlation = f"rank correlation of sampled and shown sums over {ranks[1]} elites: {ranks[0]:.3f}"
            yield note(whose + correlation)


def _pictures(experiment: Experiment | Tolerance) -> Iterator[str]:
    for path in (each for each in experiment.pictures if each.is_file()):
        picture = f'<img src="data:image/png;base64,{_base64(path)}" alt="{html.escape(words(path.stem))}">'
        yield f'<div class="scroll">{picture}</div>'


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def _asset(name: str) -> str:
    return resources.files("rtcd_jax.analysis.report").joinpath(name).read_text(encoding="utf-8")


def _plotly() -> str:
    """plotly.js, as its Python package brings it; only the file is read, which saves the import's second."""
    code = resources.files("plotly").joinpath("package_data/plotly.min.js").read_text(encoding="utf-8")
    return code.replace("</script", "<\\/script")
