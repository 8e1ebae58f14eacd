"""How the threads of torch wait for work, which OpenMP decides once, while torch is loaded."""

from collections.abc import Mapping

POLICY = "OMP_WAIT_POLICY"
# Rounds of a loop that an idle thread runs before it sleeps, about ten microseconds. GNU's OpenMP reads it.
SPIN = "GOMP_SPINCOUNT"


def waiting(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables to add before torch is loaded; none if the user has set a policy.

    Idle threads sleep, because with threads that spin, two busy programs slow each other tenfold. But first
    they spin briefly: waking a thread takes longer than most pauses within a step, and without this, small
    runs are faster on one thread than on two.
    """
    if POLICY in environment:
        return {}
    return {POLICY: "PASSIVE"} | ({} if SPIN in environment else {SPIN: "3000"})
