"""The explorer: a web page that develops one render on the device whenever its settings change.

The package may import everything that develops and measures, but not the commands. Only this
package imports Starlette and uvicorn.
"""
