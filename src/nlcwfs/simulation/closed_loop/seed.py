"""A loop under other air: telescope, mirror and reconstructor stay, which take most of the time to build."""

import copy

import equinox as eqx

from nlcwfs.feedback.controller import Controller
from nlcwfs.simulation.closed_loop.light import sequence_config
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.sequence import SequenceSimulator


def reseeded(loop: Loop, seed: int) -> Loop:
    """The same loop under the air and with the noise of another seed.

    Equal to a loop that is built with that seed: what the controller of the first has learnt is not handed on.
    """
    config = loop.config.model_copy(update={"seed": seed})
    air = SequenceSimulator.build(sequence_config(config), loop.light.still.shape)
    other = copy.copy(loop)
    other.config = config
    other.light = eqx.tree_at(lambda light: light.sequence, loop.light, air)
    other.controller = Controller.build(config.feedback, loop.light.mirror.count, config.loop.rate_hz)
    return other
