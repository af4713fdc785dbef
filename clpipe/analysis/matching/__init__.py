"""Matching: finds the development whose noise has the signature of a camera's pictures.

- ``match`` is the complete process, which uses the other modules.
- ``scenes`` reads and checks pictures.
- ``columns`` computes the statistics that are compared.
- ``space`` defines what may change.
- ``simulation`` develops a scene.
- ``search`` finds the best development, ``result`` measures and writes it, ``plot`` draws it.
"""
