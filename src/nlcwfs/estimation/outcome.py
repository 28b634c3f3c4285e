"""How a reconstruction ended, in a word and a sentence."""

import enum


class Outcome(enum.IntEnum):
    """How an iterative estimate ended; the number travels through compiled code, the sentence reaches the user.

    Examples:
        >>> Outcome.CONVERGED.succeeded, Outcome.CONVERGED.sentence
        (True, 'converged: the images explain the light as well as they will')
    """

    CONVERGED = 0
    BUDGET_SPENT = 1
    NOT_EXPLAINED = 2
    NO_LIGHT = 3
    NOT_FINITE = 4
    NOT_RUN = 5

    @property
    def succeeded(self) -> bool:
        """Whether the wavefront may be used."""
        return self in (Outcome.CONVERGED, Outcome.BUDGET_SPENT)

    @property
    def sentence(self) -> str:
        """What happened, for the user."""
        return _SENTENCES[self]


_SENTENCES = {
    Outcome.CONVERGED: "converged: the images explain the light as well as they will",
    Outcome.BUDGET_SPENT: "done: the given number of iterations ran, and the fit was still improving",
    Outcome.NOT_EXPLAINED: "not believed: the wavefront does not explain the images (a wrong solution was found)",
    Outcome.NO_LIGHT: "failed: a plane holds no light",
    Outcome.NOT_FINITE: "failed: the iteration left the finite numbers",
    Outcome.NOT_RUN: "not run: interrupted before this frame",
}
