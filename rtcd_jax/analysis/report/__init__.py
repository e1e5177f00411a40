"""Run folder -> figures, tables, one HTML page. Reads what a run has stored, and needs no JAX.

reading.py, history.py     the folder's content, and the course of its search
funnels.py, progress.py    figures/NAME.png and .pdf
plots.py, tables.py        what the page shows
page.py                    report.html
"""

from rtcd_jax.analysis.report.page import refresh, report

__all__ = ["refresh", "report"]
