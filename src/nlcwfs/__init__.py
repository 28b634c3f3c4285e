"""The toolkit of the non-linear curvature wavefront sensor: from defocused pupil images to a wavefront.

The folders are the way of the light, in its order: `atmosphere`, `beam`, `curvature_sensor`, `detector`,
`estimation`, `science`. `nlcwfs --help` shows the commands.
"""
