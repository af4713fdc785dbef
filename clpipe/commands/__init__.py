"""The command line: one module per command, and the options and tables that commands share.

A command converts its options to a request, calls one function of a lower package and prints the
result. A rule that Python users also need belongs in the lower package. This package may import
every other package. Only this package imports click and rich.
"""
