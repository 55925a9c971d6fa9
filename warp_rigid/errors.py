"""Errors raised by a running simulation. Bad input raises ValueError instead."""


class CapacityError(RuntimeError):
    """A buffer is too small and may not grow, or memory is exhausted.

    The simulator keeps the state of the last completed step.

    Attributes:
        pool: the exhausted resource: "pairs", "contacts" or "memory".
        wanted: required capacity, in entries or bytes.
        had: available capacity, in entries or bytes.
        env: the environment with the largest requirement; None if unknown.
        step: the step of that environment that exceeded the capacity; None if unknown.
    """

    def __init__(
        self, message: str, pool: str, wanted: int, had: int, env: int | None = None, step: int | None = None
    ) -> None:
        """Store the numbers along with the message."""
        super().__init__(message)
        self.pool, self.wanted, self.had, self.env, self.step = pool, wanted, had, env, step


class NonFiniteError(RuntimeError):
    """The state of an environment is no longer finite; raised with `on_nonfinite="raise"`.

    Attributes:
        env: the first such environment.
        step: the step of that environment in which the state became non-finite.
        time: the time of that step since the start of the environment [s].
        body: the first body with a non-finite state.
    """

    def __init__(self, env: int, step: int, time: float, body: int) -> None:
        """Compose the message."""
        super().__init__(f"environment {env}: body {body} is not finite since step {step} ({time:.6g} s)")
        self.env, self.step, self.time, self.body = env, step, time, body
