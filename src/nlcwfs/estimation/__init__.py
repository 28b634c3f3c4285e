"""Numbers become a wavefront.

Enters: photo-electrons `counts[plane y x]` and which of them are usable. Leaves: `WavefrontEstimate`, an unwrapped
optical path difference with its outcome. Equations: Gerchberg-Saxton replaces the modulus of the model's light on
every plane by what was measured and carries the light back to the pupil, whose modulus is known (Guyon 2010,
sec. 3.1).
"""
