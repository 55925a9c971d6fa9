"""Errors of a running simulation, beside ValueError for bad input."""

__all__ = ["CapacityError", "NonFiniteError"]


class CapacityError(RuntimeError):
    """Something does not fit, and may not grow.

    The simulator stays at the last step that fitted, so that nothing is lost.

    Attributes:
        pool: what does not fit: "pairs", "contacts" or "memory".
        wanted: entries wanted, or bytes.
        had: entries there are, or bytes allowed.
        env: the environment that wanted most of it; None where that is not known.
        step: the step of that environment that did not fit; None where that is not known.
    """

    def __init__(
        self, message: str, pool: str, wanted: int, had: int, env: int | None = None, step: int | None = None
    ) -> None:
        """Keep the numbers beside the message."""
        super().__init__(message)
        self.pool, self.wanted, self.had, self.env, self.step = pool, wanted, had, env, step


class NonFiniteError(RuntimeError):
    """The state of an environment is no longer finite, and `on_nonfinite="raise"` was asked for.

    Attributes:
        env: the first such environment.
        step: the step of that environment in which it was met.
        time: the time of that step, counted from the environment's start [s].
        body: the body in which it was met.
    """

    def __init__(self, env: int, step: int, time: float, body: int) -> None:
        """Say where and when."""
        super().__init__(f"environment {env}: body {body} is not finite since step {step} ({time:.6g} s)")
        self.env, self.step, self.time, self.body = env, step, time, body
