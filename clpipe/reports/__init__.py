"""Reports of runs: the contents of an output directory as one HTML file.

The package may import base, stage, images, chain, outputs, batch, analysis and the packages below
them. Only this package imports Jinja2.
"""
