"""One exposure, or many: the way of the light, a line for each stage, in its order.

`nlcwfs.config` reads this stage's settings, so this file imports nothing that needs the configuration.
"""
