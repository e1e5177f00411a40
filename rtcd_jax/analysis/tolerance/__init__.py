"""`rtcd tolerance`: how much of every uncertainty, and of all of them at once, a stored funnel bears.

box.py      the box and its single uncertainties, each as half widths of its own
study.py    the largest factor of each, by bisection with one compiled program; its record
figures.py  the figure
"""
