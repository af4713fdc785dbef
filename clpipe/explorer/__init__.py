"""The explorer: a web page that develops a render while its settings change.

It may import every package that develops and measures. Only the commands import it. Only this
package imports Starlette and uvicorn.
"""
