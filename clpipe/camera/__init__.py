"""What a sensor is: camera profiles and the noise model, with the built-in profiles as TOML.

Nothing here reads images or knows the chain; a profile answers "what is a and b at this ISO".
It imports ``base`` only.
"""
