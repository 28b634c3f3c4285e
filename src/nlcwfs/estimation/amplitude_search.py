"""Phase and amplitude together: from the most likely phase in even light to the most likely pair.

The search for the phase, its islands and whole turns goes before, in even light: with the amplitude free from the
start a nearly flat wavefront ends in an island more often (docs/scintillation.md).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nlcwfs.estimation.complex_phase import ComplexPhase, of_phase
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import Search, Task, solved
from nlcwfs.estimation.sensor_model import mean_counts


def with_amplitude(
    task: Task, settings: MapSettings, search: Search, root_power: Float[Array, "y fx"]
) -> tuple[Search, Float[Array, "y x"]]:
    """The best solution with the log-amplitude free too, and that log-amplitude.

    Args:
        task: The exposure in even light.
        settings: Steps and tolerance.
        search: What was found in even light.
        root_power: Root of the expected power of each wave of the log-amplitude.
    """
    prior = ComplexPhase(task.prior, root_power)
    known_rad = jnp.stack([task.problem.known_rad, jnp.zeros_like(task.problem.known_rad)])
    problem = task.problem._replace(
        expected=lambda both: mean_counts(task.level, task.scale, both), known_rad=known_rad, prior=prior
    )
    best, settings = search.best, settings.model_copy(update={"steps": settings.amplitude_steps})
    found = solved(task._replace(problem=problem), settings, prior.start(best.unknown), (best.steps, best.ffts))
    log_amplitude = prior.phase_rad(found.unknown)[1]
    return search._replace(best=found._replace(unknown=of_phase(found.unknown))), log_amplitude
