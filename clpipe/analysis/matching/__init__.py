"""Matching: from pictures of a camera to the development whose noise has the same signature.

``match`` is the whole way: ``scenes`` reads and checks pictures, ``columns`` has the figures that
are compared, ``space`` what may change, ``simulation`` develops a scene, ``search`` looks for the
best, ``result`` measures and writes it, and ``plot`` draws it.
"""
