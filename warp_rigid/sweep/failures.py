"""Errors of the user's code in a batch: the runs that they concern fail, all others and all other columns are kept."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from warp_rigid.runs.user_code import UserCodeError, errors_of


class Failures:
    """The environments of a batch in which the user's code failed.

    Args:
        num_envs: number of environments.

    Attributes:
        reasons: for each environment the first error as one line; None without an error.
        void: (envs,) bool, whether the error invalidates the simulation itself, and so all its values.
    """

    def __init__(self, num_envs: int) -> None:
        """Start without errors."""
        self.reasons: list[str | None] = [None] * num_envs
        self.void = np.zeros(num_envs, bool)

    @contextmanager
    def of(self, code: Callable, what: str, envs: Any = slice(None), void: bool = False) -> Iterator[None]:
        """Store an error of the user's code in the block, which then ends.

        Args:
            code: the user's function, class or object.
            what: its name for the message, such as "metric slope".
            envs: the environments concerned.
            void: whether an error invalidates all their values.
        """
        try:
            with errors_of(code):
                yield
        except UserCodeError as error:
            for env in np.arange(len(self.reasons))[envs]:
                self.reasons[env] = self.reasons[env] or f"{what}: {error}"
            self.void[envs] |= void
