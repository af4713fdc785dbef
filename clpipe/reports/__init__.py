"""Reports of runs: what an output folder has, looked at, as one HTML file.

May import: base, stage, images, chain, outputs, batch, analysis and the rooms below them. Only this
room imports Jinja2.
"""
