"""Run folder -> figures, tables, one HTML page. Reads what a run has stored, and needs no JAX.

reading.py, history.py     the folder's content, and the course of its search
charts.py                  what a figure shows: panels of curves, bands and shares
funnels.py, motion.py, progress.py  the figures of funnels, of the swing-up over time, and of a search
robot.py                   the robots that the page shows moving
canvas.py                  charts in print, figures/NAME.png, .pdf and .csv
traces.py, plots.py        charts and funnels on the page, by plotly.js
tables.py, elements.py     the page's tables, HTML
page.py                    report.html
"""

from rtcd_jax.analysis.report.page import refresh, report

__all__ = ["refresh", "report"]
