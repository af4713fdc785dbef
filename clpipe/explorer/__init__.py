"""A camera to try: one render developed on the device as its settings change, in a web page.

It is above everything that develops and measures, and below the commands. Starlette and uvicorn are
imported here alone.
"""
