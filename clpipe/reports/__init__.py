"""Reports of runs: the contents of an output directory as one HTML file.

May import base, stage, images, chain, outputs, batch, analysis and the packages below them. Only
this package imports Jinja2.
"""
